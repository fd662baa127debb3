"""Lever valve: a bar that turns about its hub with friction between two stops."""

from __future__ import annotations

from typing import Any

from hal.panel import Lever
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, picked, place_of
from simbackend.bodies.parts import RED, ObjectModel, moving, nearest_state
from simbackend.canvas import Canvas
from simbackend.mechanisms import TURN_DAMPING_NM_S_PER_RAD, Friction, Mechanism
from simbackend.urdf import at, box, cylinder, shape

BAR_THICKNESS_M = 0.016
"""Thickness of the bar, the top part of the lever, which reaches from the hub to the lever's length, in metres."""


class LeverBody(Body[Lever]):
    """Lever that stays where it is turned."""

    def start(self, panel_object: Lever, u: float) -> Start:
        """Return any of its states."""
        return Start(place=picked(panel_object.states, u).angle_rad)

    def model(self, panel_object: Lever, start: Start) -> ObjectModel:
        """Return hub and bar."""
        w, h, bar_m = panel_object.width_m, panel_object.height_m, panel_object.length_m
        parts = [
            shape(at(0, 0, h / 2), cylinder(0.75 * w, h), RED),
            shape(at(0, bar_m / 2, h - BAR_THICKNESS_M / 2), box((w, bar_m, BAR_THICKNESS_M)), RED),
        ]
        angles = [state.angle_rad for state in panel_object.states]
        limits = (min(angles), max(angles))
        urdf = moving(parts, kind="revolute", axis=(0, 0, -1), limits=limits, mass_kg=0.2, inertia_kg_m2=5e-4)
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Lever, start: Start, effort_ratio: float) -> Friction:
        """Return friction between two stops."""
        effort = panel_object.torque_nm * effort_ratio
        return Friction(engine=engine, body=body, effort=effort, damping=TURN_DAMPING_NM_S_PER_RAD)

    def print_on(self, canvas: Canvas, panel_object: Lever) -> None:
        """Print the names of its states, and the label."""
        for state in panel_object.states:
            canvas.place_name(panel_object.position_m, state, panel_object.length_m)
        canvas.label(panel_object.position_m, 0.020, panel_object.label)

    def truth(self, panel_object: Lever, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the state at its angle; between states there is none."""
        place = place_of(mechanism)
        return ObjectTruth(name=panel_object.name, state=nearest_state(panel_object.states, place), value=place)


BODY = LeverBody()
