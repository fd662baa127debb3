"""Press an emergency mushroom; it latches."""

from __future__ import annotations

from hal.panel import Mushroom
from manipulation.skills.outcome import SkillReport, Verify
from manipulation.skills.press import press
from manipulation.skills.subject import subject_of
from manipulation.workcell import Workcell


def mushroom(cell: Workcell, name: str, *, verify: Verify | None = None) -> SkillReport:
    """Press the mushroom until it latches.

    Raises:
        InvalidRequest: it is not a mushroom.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    panel_object = subject_of(cell, name, Mushroom, "mushroom")
    return press(
        cell,
        panel_object,
        skill="mushroom",
        target="pressed",
        is_reached=lambda seen: seen.state == "pressed",
        verify=verify,
    )
