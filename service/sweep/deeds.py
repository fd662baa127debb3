"""What a sweep asks for: one deed per control, chosen from the seed and from the state in which the control is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.panel import Button, Handwheel, Lever, Mushroom, Panel, PanelObject, Rotary, Slider, Toggle
from hal.simulated import ObjectTruth
from service.sweep.numbers import stream

STIFF_N = 85.0  # a lever that needs more at its tip must be named stiff
HELD_M = 0.010  # a finger may hold a lever this far from its tip: between the two forces, turned and stiff are right
MANY_SHARE = 0.35  # of the wheels with enough range that are turned twice round
LEAST_STEP = 0.12  # of a slider's scale
SLIDER_ENDS = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class Deed:
    """One request to `manipulate`.

    Attributes:
        row: the row of the table in which it counts.
        must_be_stiff: whether the control takes more force than the cell allows, so that the right answer is `stiff`.
        may_be_stiff: whether `stiff` is as right as the goal.
    """

    object: str
    kind: str
    row: str
    body: dict[str, Any]
    must_be_stiff: bool = False
    may_be_stiff: bool = False

    @property
    def asked(self) -> dict[str, Any]:
        """The body of the request, with the object named twice for the controls that ask for it."""
        return {**self.body, "confirm": self.object}

    @property
    def goal(self) -> str | float:
        """The state or the number that is asked for."""
        goal: str | float = next(value for key, value in self.body.items() if key != "object")
        return goal


ROWS = (
    "lever 90", "lever too stiff", "slider", "wheel 90", "wheel 720", "rotary one step", "rotary several",
    "button with lamp", "button latching", "toggle", "mushroom",
)  # fmt: skip


def deeds_of(seed: int, built: Panel, truth: dict[str, ObjectTruth]) -> list[Deed]:
    """Return the deeds on a panel, in a random order.

    Args:
        built: the panel as the simulator has it.
        truth: the states before the first deed, by name.
    """
    deeds = [deed for one in built.objects if (deed := deed_on(seed, one, truth)) is not None]
    return [deeds[k] for k in stream(seed, "deed/order").permutation(len(deeds))]


def deed_on(seed: int, one: PanelObject, truth: dict[str, ObjectTruth]) -> Deed | None:
    """Return the deed on one object; None for an instrument."""
    random = stream(seed, f"deed/{one.name}")
    match one:
        case Lever():
            return _lever(one, truth[one.name])
        case Handwheel():
            return _wheel(one, float(truth[one.name].value or 0.0), random)
        case Slider():
            return _asked(one, "slider", value=_slider_goal(one, float(truth[one.name].value or 0.0), random))
        case Rotary():
            return _rotary(one, truth[one.name], random)
        case Button() if one.lights_lamp is not None:
            return _asked(one, "button with lamp", state=_other(truth[one.lights_lamp].state, ("on", "off")))
        case Button() if one.latching:
            return _asked(one, "button latching", state=_other(truth[one.name].state, ("pressed", "released")))
        case Toggle():
            return _asked(one, "toggle", state=_other(truth[one.name].state, ("on", "off")))
        case Mushroom():
            return _asked(one, "mushroom", state="pressed")
        case _:
            return None


def _asked(one: PanelObject, row: str, **goal: Any) -> Deed:
    return Deed(object=one.name, kind=one.kind, row=row, body={"object": one.name, **goal})


def _other(now: str | None, states: tuple[str, ...]) -> str:
    return next(state for state in states if state != now)


def _lever(one: Lever, now: ObjectTruth) -> Deed:
    body = {"object": one.name, "state": _other(now.state, tuple(state.name for state in one.states))}
    must = one.torque_nm / one.length_m > STIFF_N
    may = one.torque_nm / (one.length_m - HELD_M) > STIFF_N
    row = "lever too stiff" if must else "lever 90"
    return Deed(object=one.name, kind=one.kind, row=row, body=body, must_be_stiff=must, may_be_stiff=may)


def _wheel(one: Handwheel, now_rad: float, random: np.random.Generator) -> Deed:
    wants_many, sign = random.uniform() < MANY_SHARE, 1.0 if random.uniform() < 0.5 else -1.0
    for turn, row in (
        *(((4.0 * math.pi, "wheel 720"), (-4.0 * math.pi, "wheel 720")) if wants_many else ()),
        (math.pi / 2, "wheel 90"),
        (-math.pi / 2, "wheel 90"),
    ):
        goal = now_rad + sign * turn
        if one.minimum_rad <= goal <= one.maximum_rad:
            return _asked(one, row, angle_rad=round(goal, 4))
    raise AssertionError("a wheel has room for a quarter of a turn")


def _slider_goal(one: Slider, now: float, random: np.random.Generator) -> float:
    scale = one.scale
    while True:
        share = float(random.uniform(SLIDER_ENDS, 1.0 - SLIDER_ENDS))
        goal = scale.minimum + share * scale.span
        if abs(goal - now) >= LEAST_STEP * scale.span:
            return round(goal, 3)


def _rotary(one: Rotary, now: ObjectTruth, random: np.random.Generator) -> Deed:
    names = [state.name for state in one.states]
    here = names.index(str(now.state))
    others = [k for k in range(len(names)) if k != here]
    goal = int(random.choice(others))
    row = "rotary one step" if abs(goal - here) == 1 else "rotary several"
    return _asked(one, row, state=names[goal])
