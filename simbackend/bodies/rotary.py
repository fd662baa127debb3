"""Selector: a knob with a bar that rests in one of several detents."""

from __future__ import annotations

from typing import Any

from hal.panel import Rotary
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, picked, place_of
from simbackend.bodies.parts import KNOB, WHITE, ObjectModel, moving, nearest_state
from simbackend.canvas import Canvas
from simbackend.mechanisms import Detent, Mechanism
from simbackend.urdf import at, box, cylinder, shape


class RotaryBody(Body[Rotary]):
    """Selector that points at one of its states."""

    def start(self, panel_object: Rotary, u: float) -> Start:
        """Return any of its states."""
        return Start(place=picked(panel_object.states, u).angle_rad)

    def model(self, panel_object: Rotary, start: Start) -> ObjectModel:
        """Return knob, bar and mark."""
        angles = [state.angle_rad for state in panel_object.states]
        limits = (min(angles) - 0.1, max(angles) + 0.1)
        parts = knob_with_bar(panel_object.radius_m, panel_object.height_m, panel_object.bar_width_m)
        urdf = moving(parts, kind="revolute", axis=(0, 0, -1), limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4)
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Rotary, start: Start, effort_ratio: float) -> Detent:
        """Return a detent that snaps to the nearest state."""
        places = tuple(state.angle_rad for state in panel_object.states)
        effort = panel_object.torque_nm * effort_ratio
        return Detent(engine=engine, body=body, places=places, effort=effort, max_speed=6.0)

    def print_on(self, canvas: Canvas, panel_object: Rotary) -> None:
        """Print the names of its states, and the label."""
        for state in panel_object.states:
            canvas.place_name(panel_object.position_m, state, panel_object.radius_m)
        canvas.label(panel_object.position_m, panel_object.radius_m + 0.0025, panel_object.label)

    def truth(self, panel_object: Rotary, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the state that it points at; between states there is none."""
        place = place_of(mechanism)
        return ObjectTruth(name=panel_object.name, state=nearest_state(panel_object.states, place), value=place)


def knob_with_bar(radius_m: float, height_m: float, bar_m: float) -> list[list[str]]:
    """Return a round shoulder, a bar across it to grip, and a white mark on the bar's end."""
    r, h = radius_m, height_m
    return [
        shape(at(0, 0, h / 4), cylinder(r, h / 2), KNOB),
        shape(at(0, 0, 0.75 * h), box((bar_m, 2 * r, h / 2)), KNOB),
        shape(at(0, 0.6 * r, h), box((0.12 * r, 0.75 * r, 0.0006)), WHITE, collision=False),
    ]


BODY = RotaryBody()
