"""Press an emergency mushroom; it latches."""

from __future__ import annotations

from hal.panel import Mushroom
from manipulation.skills.context import SkillContext
from manipulation.skills.initial_state import object_of_kind
from manipulation.skills.outcome import SkillReport, Verify
from manipulation.skills.press import press


def mushroom(context: SkillContext, name: str, *, verify: Verify | None = None) -> SkillReport:
    """Press the mushroom until it latches.

    Raises:
        InvalidRequest: it is not a mushroom.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    panel_object = object_of_kind(context, name, Mushroom, "mushroom")
    return press(
        context,
        panel_object,
        skill="mushroom",
        target="pressed",
        is_reached=lambda seen: seen.state == "pressed",
        verify=verify,
    )
