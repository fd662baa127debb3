"""Presses an emergency mushroom button, which latches."""

from __future__ import annotations

from hal.panel import Mushroom
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, SkillReport, Verify
from manipulation.skills.press import press_latching


def mushroom(
    context: SkillContext,
    cap: Mushroom,
    target: str = "pressed",
    *,
    current: ObjectState | None = None,  # noqa: ARG001 - not needed, because the head's height is felt
    verify: Verify | None = None,
) -> SkillReport:
    """Press the mushroom until it is felt to be latched.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    return press_latching(context, cap, target, skill="mushroom", releases=False, verify=verify)
