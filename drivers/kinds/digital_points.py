"""Lights and pads on digital points, whatever wire leads to them: one point each, and a checked command."""

from __future__ import annotations

from collections.abc import Sequence

from hal.errors import InvalidRequest


def require_same_number(what: str, *lists: Sequence[object] | None) -> None:
    """All lists that are given have the same number of entries, at least one.

    Raises:
        ValueError: they have not; `what` names their keys.
    """
    counts = {len(entries) for entries in lists if entries is not None}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"{what} need the same number of entries, at least one")


def wanted_lights(device: str, channels: Sequence[str], on: Sequence[bool]) -> tuple[bool, ...]:
    """What to switch, one value a light.

    Raises:
        InvalidRequest: another number of values.
    """
    if len(on) == len(channels):
        return tuple(bool(value) for value in on)
    raise InvalidRequest(
        f"{device} has {len(channels)} lights, not {len(on)}",
        hint=f"give one value for each of {', '.join(channels)}",
        device=device,
    )
