"""Press a push button."""

from __future__ import annotations

from dataclasses import replace

from hal.panel import Button
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, Outcome, SkillReport, Verify
from manipulation.skills.press import press


def button(
    context: SkillContext,
    push_button: Button,
    expected: str | None = None,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Press the button once; not at all when what is expected is there already, since a press would undo it.

    One that springs back and works no lamp shows nothing afterwards: its outcome is `unverified`.

    Args:
        expected: the state that the read-back must show afterwards: `pressed` or `released` of a latching button, or
            the state of the lamp that it works. None accepts any read-back that gives an answer.
        current: what the last look showed of what the button works.
        verify: the caller's second look.

    Raises:
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    shows = push_button.latching or push_button.lights_lamp is not None
    report = press(
        context,
        push_button,
        skill="button",
        target=expected or "pressed once",
        is_reached=lambda seen: expected is None or seen.state == expected,
        verify=verify if shows or expected is None else None,
        is_there=verify is not None and current is not None and current.state == expected,
    )
    if shows or report.outcome is not Outcome.UNVERIFIED:
        return report
    return replace(report, cause="the stroke ended as declared; it springs back and works no lamp that would show it")
