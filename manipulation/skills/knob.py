"""Turns a knob to a value of its scale: holds its bar lightly and turns about its axis."""

from __future__ import annotations

import numpy as np

from hal.errors import InvalidRequest
from hal.panel.knob import Knob
from manipulation.skills.attempt import Attempt
from manipulation.skills.context import SkillContext
from manipulation.skills.initial_state import InitialState
from manipulation.skills.outcome import ObjectState, SkillReport, Verify, doubt_within, surely_within
from manipulation.skills.repeat import perform
from manipulation.skills.rotary import turn_bar

TOLERANCE_RATIO = 0.02
GIVE_RAD = np.radians(8.3)
"""How far the pads lag behind on the bar, under the knob's friction, at the end of a long turn.

Measured: 4 degrees in a turn of 9, 8 in turns of 28 to 103. A firmer grip lags less, but at 25 N a side force of up to 50 N
ends the turn."""
GIVE_WITHIN_RAD = np.radians(7.0)
"""The turn in which 63 % of that lag has come about."""


def knob(
    context: SkillContext,
    panel_object: Knob,
    target: float,
    *,
    current: ObjectState | None = None,
    verify: Verify | None = None,
) -> SkillReport:
    """Turn the knob by the angle between the value that it shows and `target`.

    The mechanical estimate in the report is the value reached.

    Args:
        current: what the last observation showed; without it `verify` is asked.
        verify: the caller's read-back.

    Raises:
        InvalidRequest: the value is off the scale, or the present value is not known.
        DeviceFault, Stopped, Cancelled: the cell cannot go on.
    """
    name, scale = panel_object.name, panel_object.scale
    allowed = TOLERANCE_RATIO * scale.span
    if not scale.minimum <= target <= scale.maximum:
        raise InvalidRequest(
            f"{target} {scale.unit} is off the scale of {name}", hint=f"{scale.minimum} to {scale.maximum} {scale.unit}"
        )
    where = InitialState(lambda seen: seen.value, what=f"the value of {name}", current=current, verify=verify)

    def stroke(attempt: Attempt) -> float:
        start, goal = scale.place_of(where.known), scale.place_of(target)
        lag = GIVE_RAD * (1.0 - float(np.exp(-abs(goal - start) / GIVE_WITHIN_RAD)))
        return where.moved_to(scale.value_at(turn_bar(attempt, panel_object, start, goal, over_rad=lag)))

    return perform(
        context,
        stroke,
        skill="knob",
        object_name=name,
        target=f"{target:g} {scale.unit}".strip(),
        is_reached=lambda seen: surely_within(seen.value, target, allowed, sigma=seen.sigma),
        doubt=lambda seen: doubt_within(seen.value, target, allowed, sigma=seen.sigma),
        verify=where.verify,
    )
