"""An arm against where its drives hold it: one that is believed wrongly leaps there with its next set-point."""

from __future__ import annotations

from manipulation.plausibility.finding import Finding, Symptom

FOLLOWING_LIMIT_M = 0.02  # of the tips; tracking in a motion is held to the same


def does_not_follow(arm: str, apart_m: float, how: str) -> Finding | None:
    """Find an arm whose tips are too far from where they should be.

    Args:
        apart_m: distance of the tips.
        how: what the distance is, with `{}` where its millimetres go.
    """
    if apart_m < FOLLOWING_LIMIT_M:
        return None
    return Finding(
        device=arm,
        symptom=Symptom.DISOBEYS,
        what=f"{arm} does not follow: {how.format(f'{1e3 * apart_m:.0f} mm')}",
        remedy="",
    )
