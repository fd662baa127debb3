"""Presses an emergency mushroom button, which latches."""

from __future__ import annotations

from hal.panel import Mushroom
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, SkillReport, Verify
from manipulation.skills.press import press


def mushroom(
    context: SkillContext,
    cap: Mushroom,
    target: str = "pressed",
    *,
    current: ObjectState | None = None,  # noqa: ARG001 - not needed, because a second press leaves a latched cap latched
    verify: Verify | None = None,
) -> SkillReport:
    """Press the mushroom until it latches.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    return press(
        context, cap, skill="mushroom", target=target, is_reached=lambda seen: seen.state == target, verify=verify
    )
