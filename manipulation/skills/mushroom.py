"""Press an emergency mushroom; it latches."""

from __future__ import annotations

from hal.errors import InvalidRequest
from hal.panel import Mushroom
from manipulation.skills.outcome import SkillReport, Verify
from manipulation.skills.press import press
from manipulation.workcell import Workcell


def mushroom(cell: Workcell, name: str, *, verify: Verify | None = None) -> SkillReport:
    """Press the mushroom until it latches.

    Raises:
        InvalidRequest: it is not a mushroom.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    thing = cell.panel.object(name)
    if not isinstance(thing, Mushroom):
        raise InvalidRequest(f"{name} is a {thing.kind}, not a mushroom", hint="see the panel file")
    return press(
        cell,
        thing,
        skill="mushroom",
        target="pressed",
        is_reached=lambda seen: seen.state == "pressed",
        verify=verify,
    )
