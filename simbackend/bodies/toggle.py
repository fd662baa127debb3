"""Toggle switch: a bat that rests in one of two positions."""

from __future__ import annotations

from typing import Any

from hal.panel import Toggle
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import STEEL, WHITE, ObjectModel, moving
from simbackend.canvas import RIM, Canvas
from simbackend.mechanisms import Detent, Mechanism
from simbackend.urdf import at, cylinder, shape, sphere

PIVOT_M = 0.004


class ToggleBody(Body[Toggle]):
    """Toggle switch; up is on."""

    def start(self, panel_object: Toggle, u: float) -> Start:
        """Return a state that is on with probability one half."""
        return Start(place=panel_object.tilt_rad if u < 0.5 else -panel_object.tilt_rad)

    def model(self, panel_object: Toggle, start: Start) -> ObjectModel:
        """Return bat and nut."""
        reach_m, r = panel_object.bat_length_m, panel_object.bat_radius_m
        parts = [
            shape(at(0, 0, reach_m / 2), cylinder(0.7 * r, reach_m), STEEL),
            shape(at(0, 0, reach_m - r), sphere(r), WHITE),
        ]
        nut = shape(at(0, 0, 0.002), cylinder(1.8 * r, 0.004), (0.55, 0.56, 0.58))
        urdf = moving(
            parts,
            kind="revolute",
            axis=(-1, 0, 0),
            limits=(-panel_object.tilt_rad, panel_object.tilt_rad),
            mass_kg=0.02,
            inertia_kg_m2=1e-4,
            pivot_m=(0, 0, PIVOT_M),
            fixed=[nut],
        )
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Toggle, start: Start, effort_ratio: float) -> Detent:
        """Return a detent that snaps to the nearer end."""
        ends = (-panel_object.tilt_rad, panel_object.tilt_rad)
        effort = panel_object.force_n * panel_object.bat_length_m * effort_ratio
        return Detent(engine=engine, body=body, places=ends, effort=effort, max_speed=8.0)

    def print_on(self, canvas: Canvas, panel_object: Toggle) -> None:
        """Print a dark plate, ON and OFF beside it, and the label."""
        canvas.box(panel_object.position_m, (0.026, 0.044), RIM, round_m=0.003)
        x, y = panel_object.position_m
        canvas.text((x + 0.021, y + 0.015), "ON", 0.0045)
        canvas.text((x + 0.021, y - 0.015), "OFF", 0.0045)
        canvas.label(panel_object.position_m, 0.022, panel_object.label)

    def truth(self, panel_object: Toggle, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return on when the bat points up."""
        place = place_of(mechanism)
        return ObjectTruth(name=panel_object.name, state="on" if place > 0.0 else "off", value=place)


BODY = ToggleBody()
