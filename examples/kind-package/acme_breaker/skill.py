"""Throws a breaker: a closed fingertip sweeps its handle over; one that has tripped is thrown off first."""

from __future__ import annotations

from acme_breaker.model import Breaker
from manipulation.skills import Attempt, ObjectState, SkillContext, SkillReport, Verify, perform, throw


def breaker(
    context: SkillContext,
    panel_object: Breaker,
    target: str,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Throw the breaker to `on` or `off`. From `tripped`, or when nobody knows its state, it goes through `off` to `on`.

    Args:
        current: what the last look showed.
        verify: the caller's second look.
    """

    def stroke(attempt: Attempt) -> float:
        if target == "on" and (current is None or current.state != "off"):
            throw(attempt, panel_object, -1.0)
        return throw(attempt, panel_object, 1.0 if target == "on" else -1.0)

    return perform(
        context,
        stroke,
        skill="breaker",
        object_name=panel_object.name,
        target=target,
        is_reached=lambda seen: seen.state == target,
        verify=verify,
    )
