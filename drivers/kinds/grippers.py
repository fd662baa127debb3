"""Checks shared by gripper drivers: the counts at the ends of the stroke, and the values of a command."""

from __future__ import annotations

import math

from hal.errors import InvalidRequest


def require_stroke(open_count: int, closed_count: int) -> None:
    """Raise `ValueError` if both ends of the stroke have the same count, because no width follows from it."""
    if open_count == closed_count:
        raise ValueError("open_count and closed_count are the ends of the stroke and must differ")


def require_finite(device: str, width_m: float, force_n: float, speed_m_per_s: float) -> None:
    """Raise `InvalidRequest` if a value of a command is not finite."""
    if not all(math.isfinite(value) for value in (width_m, force_n, speed_m_per_s)):
        raise InvalidRequest(f"{device}: width, force and speed must be finite", hint="send numbers", device=device)
