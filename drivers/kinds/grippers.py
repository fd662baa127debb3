"""What wired grippers check alike: the counts at the ends of the stroke, and the numbers of a command."""

from __future__ import annotations

import math

from hal.errors import InvalidRequest


def require_stroke(open_count: int, closed_count: int) -> None:
    """Raise `ValueError` when both ends of the stroke are one count, so that no width follows from it."""
    if open_count == closed_count:
        raise ValueError("open_count and closed_count are the ends of the stroke and must differ")


def require_finite(device: str, width_m: float, force_n: float, speed_m_per_s: float) -> None:
    """Raise `InvalidRequest` when a number of a command is not finite."""
    if not all(math.isfinite(value) for value in (width_m, force_n, speed_m_per_s)):
        raise InvalidRequest(f"{device}: width, force and speed must be finite", hint="send numbers", device=device)
