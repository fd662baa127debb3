"""Switches a breaker: a closed fingertip pushes its handle over; a tripped breaker is first switched off."""

from __future__ import annotations

from acme_breaker.model import Breaker
from manipulation.skills import Attempt, ObjectState, SkillContext, SkillReport, Verify, perform, throw

GRIP_RATIO = 0.7
"""How far up the handle the fingertip pushes: its flat side holds the finger, and a longer arm needs less force."""


def breaker(
    context: SkillContext,
    panel_object: Breaker,
    target: str,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Switch the breaker to `on` or `off`; if it has tripped or its state is unknown, it is switched off before on.

    Args:
        current: state from the last image.
        verify: reads the state again after the motion.
    """

    def stroke(attempt: Attempt) -> float:
        if target == "on" and (current is None or current.state != "off"):
            throw(attempt, panel_object, -1.0, grip_ratio=GRIP_RATIO)
        return throw(attempt, panel_object, 1.0 if target == "on" else -1.0, grip_ratio=GRIP_RATIO)

    return perform(
        context,
        stroke,
        skill="breaker",
        object_name=panel_object.name,
        target=target,
        is_reached=lambda seen: seen.state == target,
        verify=verify,
    )
