"""Press a push button."""

from __future__ import annotations

from hal.panel import Button
from manipulation.skills.outcome import SkillReport, Verify
from manipulation.skills.press import press
from manipulation.skills.subject import subject_of
from manipulation.workcell import Workcell


def button(cell: Workcell, name: str, *, expected: str | None = None, verify: Verify | None = None) -> SkillReport:
    """Press the button once.

    Args:
        expected: the state that the read-back must show afterwards: `pressed` or `released` of a latching button, or
        the state of the lamp that it works. None: any read-back will do that says something.
        verify: the caller's second look.

    Raises:
        InvalidRequest: it is not a button.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    thing = subject_of(cell, name, Button, "button")
    return press(
        cell,
        thing,
        skill="button",
        target=expected or "pressed once",
        is_reached=lambda seen: expected is None or seen.state == expected,
        verify=verify,
    )
