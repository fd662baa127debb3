"""The single entry point of the skills: finds the skill by the kind of the object."""

from __future__ import annotations

from typing import Any, Protocol

from hal.panel import PanelObject
from hal.panel.kinds import SKILLS, part_of
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, SkillReport, Verify


class Skill(Protocol):
    """A function that operates one kind of control.

    The panel object is of that kind. The goal is one of the kind's states, or a number in the unit of its scale (an
    angle in rad where the kind has no scale).
    """

    def __call__(
        self,
        context: SkillContext,
        panel_object: Any,
        goal: Any,
        /,
        *,
        current: ObjectState | None = None,
        verify: Verify | None = None,
    ) -> SkillReport:
        """Operate the object until `goal` is reached, as confirmed by `verify`; `current` is the last observation."""
        ...


def operate(
    context: SkillContext,
    panel_object: PanelObject,
    goal: str | float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Operate a control of the panel with the skill of its kind.

    Args:
        goal: a state of the object, or a number: a value of its scale, or an angle in rad, clockwise from up.
        current: what the last observation showed of it; without it `verify` is asked where the skill must know.
        verify: the caller's read-back. Without it nothing is confirmed, and a finished stroke is `unverified`.

    Raises:
        Unsupported: the kind has no skill, because it can only be read.
        InvalidRequest: the object has no such state or value.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    skill: Skill = part_of(SKILLS, panel_object.kind)
    return skill(context, panel_object, goal, current=current, verify=verify)
