"""Presses a push button."""

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
    """Press the button once, but not if the expected state was already seen, because a press would undo it.

    A button that springs back and switches no lamp shows nothing afterwards, so its outcome is `unverified`.

    Args:
        expected: the state that the read-back must show afterwards: `pressed` or `released` of a latching button, or
            the state of the lamp that the button works. None accepts any conclusive read-back.
        current: what the last observation showed of the button or its lamp.
        verify: the caller's read-back.

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
