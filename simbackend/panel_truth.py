"""What an object of the simulated panel truly shows: for the judge of a finished mission."""

from __future__ import annotations

from hal.panel import Button, Gauge, Handwheel, Lamp, Lever, Mushroom, PanelMeter, Rotary, Slider, State, Toggle
from hal.simulated import ObjectTruth
from simbackend.mechanisms import Mechanism, Spring
from simbackend.panel_state import Built

STATE_SLACK_RAD = 0.2


def truth_of(built: Built, mechanism: Mechanism | None, *, lamp_is_on: bool) -> ObjectTruth:
    """Value, state and text of one object.

    A lever or rotary between its resting places has no state; a button's value is the number of its presses.
    """
    panel_object = built.panel_object
    name = panel_object.name
    place = mechanism.place() if mechanism is not None else 0.0
    match panel_object:
        case Gauge() | PanelMeter() | Slider():
            return ObjectTruth(name=name, value=panel_object.scale.value_at(place))
        case Lamp():
            return ObjectTruth(name=name, state="on" if lamp_is_on else "off")
        case Button() | Mushroom() if isinstance(mechanism, Spring):
            is_pressed = mechanism.is_latched or mechanism.is_in
            return ObjectTruth(name=name, state="pressed" if is_pressed else "released", value=float(mechanism.presses))
        case Toggle():
            return ObjectTruth(name=name, state="on" if place > 0.0 else "off", value=place)
        case Rotary() | Lever():
            return ObjectTruth(name=name, state=nearest_state(panel_object.states, place), value=place)
        case Handwheel():
            return ObjectTruth(name=name, value=place)
        case _:
            return ObjectTruth(name=name, value=built.value, text=built.text)


def nearest_state(states: tuple[State, ...], angle_rad: float) -> str | None:
    """The state whose place is nearest, None when even that is far."""
    state = min(states, key=lambda s: abs(s.angle_rad - angle_rad))
    return state.name if abs(state.angle_rad - angle_rad) <= STATE_SLACK_RAD else None
