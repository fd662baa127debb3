"""Press a push button."""

from __future__ import annotations

from dataclasses import replace

from hal.panel import Button
from manipulation.skills.context import SkillContext
from manipulation.skills.initial_state import object_of_kind
from manipulation.skills.outcome import ObjectState, Outcome, SkillReport, Verify
from manipulation.skills.press import press


def button(
    context: SkillContext,
    name: str,
    *,
    expected: str | None = None,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Press the button once; not at all when what is expected is there already, since a press would undo it.

    One that springs back and works no lamp shows nothing afterwards: its outcome is `unverified`.

    Args:
        expected: the state that the read-back must show afterwards: `pressed` or `released` of a latching button, or
        the state of the lamp that it works. None: any read-back will do that says something.
        current: what the last look said of what the button works.
        verify: the caller's second look.

    Raises:
        InvalidRequest: it is not a button.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    panel_object = object_of_kind(context, name, Button, "button")
    shows = panel_object.latching or panel_object.lights_lamp is not None
    report = press(
        context,
        panel_object,
        skill="button",
        target=expected or "pressed once",
        is_reached=lambda seen: expected is None or seen.state == expected,
        verify=verify if shows or expected is None else None,
        is_there=verify is not None and current is not None and current.state == expected,
    )
    if shows or report.outcome is not Outcome.UNVERIFIED:
        return report
    return replace(report, cause="the stroke ended as declared; it springs back and works no lamp that would show it")
