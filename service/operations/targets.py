"""What a deed shall reach; asked before anything moves, so that a request that makes no sense moves nothing."""

from __future__ import annotations

from hal.config import Cell
from hal.errors import InvalidRequest
from hal.panel import Button, Handwheel, Lever, Mushroom, PanelObject, Rotary, Slider, Toggle
from service.schema.requests import ActionBody, InspectRequest, ManipulateRequest, MissionRequest, RecogniseRequest


def target_of(panel_object: PanelObject, body: ActionBody) -> str | float:
    """The state or number that shall be reached; the usual one of its kind when nothing is asked.

    Raises:
        InvalidRequest: the object cannot be worked, or has no such state or value.
    """
    match panel_object:
        case Slider():
            _only(panel_object, body, "value")
            return _number(
                panel_object,
                body.value,
                panel_object.scale.minimum,
                panel_object.scale.maximum,
                panel_object.scale.unit,
                "value",
            )
        case Handwheel():
            _only(panel_object, body, "angle_rad")
            return _number(
                panel_object, body.angle_rad, panel_object.minimum_rad, panel_object.maximum_rad, "rad", "angle_rad"
            )
        case Lever() | Rotary():
            _only(panel_object, body, "state")
            return _one_of(panel_object, body.state, tuple(state.name for state in panel_object.states))
        case Toggle():
            _only(panel_object, body, "state")
            return _one_of(panel_object, body.state, ("on", "off"))
        case Mushroom():
            _only(panel_object, body, "state")
            return _one_of(panel_object, body.state or "pressed", ("pressed",))
        case Button():
            _only(panel_object, body, "state")
            states = button_states(panel_object)
            return _one_of(panel_object, body.state or states[0], states)
    raise unworkable(panel_object)


def check_manipulate(cell: Cell, request: ManipulateRequest) -> None:
    """Raise `InvalidRequest` for a deed that makes no sense on the cell's panel."""
    target_of(cell.panel.object(request.object), request)


def check_mission(cell: Cell, request: MissionRequest) -> None:
    """Raise `InvalidRequest` when one of the deeds makes no sense on the cell's panel."""
    for body in request.actions or ():
        target_of(cell.panel.object(body.object), body)


def check_looked_for(cell: Cell, request: InspectRequest | RecogniseRequest) -> None:
    """Raise `InvalidRequest` for an object that the cell's panel does not have, unless a stored image is asked about."""
    if request.image is None:
        for name in request.objects or ():
            cell.panel.object(name)


def button_states(panel_object: Button) -> tuple[str, ...]:
    """What a press can bring about: states of its lamp, or of the cap itself, which only stays in when it latches."""
    if panel_object.lights_lamp is not None:
        return ("on", "off")
    return ("pressed", "released") if panel_object.latching else ("pressed",)


def _only(panel_object: PanelObject, body: ActionBody, key: str) -> None:
    """Raise unless what is asked for is asked for under `key`: what is meant must not be guessed."""
    for other in {"state", "value", "angle_rad"} - {key}:
        if getattr(body, other) is not None:
            hint = f"send {{'object': '{panel_object.name}', '{key}': ...}}"
            raise InvalidRequest(
                f"{panel_object.name} is a {panel_object.kind}: it takes {key}, not {other}", hint=hint
            )


def _number(panel_object: PanelObject, asked: float | None, low: float, high: float, unit: str, key: str) -> float:
    if asked is None or not low <= asked <= high:
        raise InvalidRequest(
            f"{panel_object.name} needs {key} from {low:g} to {high:g} {unit}".rstrip(),
            hint=f"send {{'object': '{panel_object.name}', '{key}': ...}}",
        )
    return asked


def _one_of(panel_object: PanelObject, state: str | None, states: tuple[str, ...]) -> str:
    if state is None:
        raise InvalidRequest(f"{panel_object.name} needs a state", hint=f"states: {', '.join(states)}")
    if state not in states:
        raise InvalidRequest(f"{panel_object.name} has no state {state!r}", hint=f"states: {', '.join(states)}")
    return state


def unworkable(panel_object: PanelObject) -> InvalidRequest:
    """The refusal to work an object that only shows something."""
    return InvalidRequest(
        f"{panel_object.name} is a {panel_object.kind}, which cannot be worked",
        hint="levers, sliders, toggles, rotaries, wheels, buttons and mushrooms can",
    )
