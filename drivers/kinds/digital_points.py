"""Code shared by lights and touch pads on digital inputs and outputs: option checks and command checks."""

from __future__ import annotations

from collections.abc import Sequence

from hal.errors import InvalidRequest


def require_same_number(what: str, *lists: Sequence[object] | None) -> None:
    """Check that all lists given have the same number of entries, at least one.

    Raises:
        ValueError: they do not; `what` names their keys.
    """
    counts = {len(entries) for entries in lists if entries is not None}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"{what} need the same number of entries, at least one")


def wanted_lights(device: str, channels: Sequence[str], on: Sequence[bool]) -> tuple[bool, ...]:
    """Return the commanded states, one value per light.

    Raises:
        InvalidRequest: the number of values differs from the number of lights.
    """
    if len(on) == len(channels):
        return tuple(bool(value) for value in on)
    raise InvalidRequest(
        f"{device} has {len(channels)} lights, not {len(on)}",
        hint=f"give one value for each of {', '.join(channels)}",
        device=device,
    )
