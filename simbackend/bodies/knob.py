"""Knob: turns about its axis with friction between the ends of its scale and stays where it is turned."""

from __future__ import annotations

from typing import Any

from hal.panel.knob import Knob
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import ObjectModel, moving
from simbackend.bodies.rotary import knob_with_bar
from simbackend.canvas import Canvas
from simbackend.mechanisms import TURN_DAMPING_NM_S_PER_RAD, Friction, Mechanism


class KnobBody(Body[Knob]):
    """Knob that stays where it is turned."""

    def start(self, panel_object: Knob, u: float) -> Start:
        """Return a value away from the ends of the scale."""
        scale = panel_object.scale
        value = scale.minimum + (0.1 + 0.8 * u) * scale.span
        return Start(place=scale.place_of(value), value=value)

    def model(self, panel_object: Knob, start: Start) -> ObjectModel:
        """Return knob, bar and mark."""
        low, high = sorted((panel_object.scale.at_min, panel_object.scale.at_max))
        parts = knob_with_bar(panel_object.radius_m, panel_object.height_m, panel_object.bar_width_m)
        limits = (low - 0.05, high + 0.05)
        urdf = moving(parts, kind="revolute", axis=(0, 0, -1), limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4)
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Knob, start: Start, effort_ratio: float) -> Friction:
        """Return friction between two stops."""
        effort = panel_object.torque_nm * effort_ratio
        return Friction(engine=engine, body=body, effort=effort, damping=TURN_DAMPING_NM_S_PER_RAD)

    def print_on(self, canvas: Canvas, panel_object: Knob) -> None:
        """Print ticks and numerals around the knob, and the label."""
        r = panel_object.radius_m
        canvas.scale(panel_object.position_m, panel_object.scale, outer_m=r + 0.006, text_m=r + 0.011, tall_m=0.0038)
        canvas.label(panel_object.position_m, r + 0.008, panel_object.label)

    def truth(self, panel_object: Knob, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the value that its mark points at."""
        return ObjectTruth(name=panel_object.name, value=panel_object.scale.value_at(place_of(mechanism)))


BODY = KnobBody()
