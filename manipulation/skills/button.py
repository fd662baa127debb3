"""Presses a push button."""

from __future__ import annotations

from hal.errors import InvalidRequest
from hal.panel import Button
from hal.panel.button import PRESSED_ONCE
from manipulation.skills.context import SkillContext
from manipulation.skills.outcome import ObjectState, SkillReport, Verify
from manipulation.skills.press import press_latching, press_once


def button(
    context: SkillContext,
    push_button: Button,
    expected: str | None = None,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Press the button once, but not if the expected state was already seen, because a press would undo it.

    The lamp that the button works shows the effect. A latching button without a lamp is felt: a latched cap stands lower.
    A button that springs back and works no lamp is done when the fingers felt its travel and its return.

    Args:
        expected: the state that the read-back must show afterwards: `pressed` or `released` of a latching button, or
            the state of the lamp that the button works. None accepts any conclusive read-back.
        current: what the last observation showed of the button or its lamp.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: a state is expected of a button that springs back and works no lamp.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    wanted = None if expected == PRESSED_ONCE else expected
    if push_button.lights_lamp is None and push_button.latching:
        return press_latching(context, push_button, wanted, skill="button", releases=True, verify=verify)
    if push_button.lights_lamp is None and wanted is not None:
        raise InvalidRequest(
            f"{push_button.name} springs back and works no lamp, so nothing could show that it is {wanted!r}",
            hint="leave the state out: it is then pressed once, and its felt travel confirms that",
        )
    return press_once(
        context,
        push_button,
        target=wanted or PRESSED_ONCE,
        is_reached=lambda seen: wanted is None or seen.state == wanted,
        verify=verify if push_button.lights_lamp is not None else None,
        is_there=wanted is not None and verify is not None and current is not None and current.state == wanted,
    )
