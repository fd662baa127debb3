"""Compares the arm's reported position with that of its drives, because a wrong one would make the arm jump."""

from __future__ import annotations

from manipulation.plausibility.finding import Finding, Symptom

FOLLOWING_LIMIT_M = 0.02  # of the tips; the tracking guard of a motion has the same limit


def does_not_follow(arm: str, apart_m: float, how: str) -> Finding | None:
    """Find an arm whose tips are too far from where they should be.

    Args:
        apart_m: distance between reported and expected tips.
        how: a description of that distance, with `{}` in place of its millimetres.
    """
    if apart_m < FOLLOWING_LIMIT_M:
        return None
    return Finding(
        device=arm,
        symptom=Symptom.DISOBEYS,
        what=f"{arm} does not follow: {how.format(f'{1e3 * apart_m:.0f} mm')}",
        remedy="",
    )
