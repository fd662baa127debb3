"""An emergency mushroom: a wide head on a spring, which latches and stays."""

from __future__ import annotations

from typing import Any

from hal.panel import Mushroom
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start
from simbackend.bodies.button import pressed, spring
from simbackend.bodies.parts import RED, ObjectModel, moving
from simbackend.canvas import YELLOW, Canvas
from simbackend.mechanisms import Mechanism, Spring
from simbackend.urdf import at, cylinder, shape


class MushroomBody(Body[Mushroom]):
    """Released at first."""

    def start(self, panel_object: Mushroom, u: float) -> Start:
        """Released."""
        return Start()

    def model(self, panel_object: Mushroom, start: Start) -> ObjectModel:
        """Head and stem."""
        r, h = panel_object.radius_m, panel_object.height_m
        head_m = 0.5 * h
        parts = [
            shape(at(0, 0, h - head_m / 2), cylinder(r, head_m), RED),
            shape(at(0, 0, h / 2 - 0.002), cylinder(0.5 * r, h - 0.004), RED),
        ]
        limits = (-panel_object.travel_m, 0.0)
        return ObjectModel(
            urdf=moving(parts, kind="prismatic", axis=(0, 0, 1), limits=limits, mass_kg=0.08, inertia_kg_m2=1e-4)
        )

    def mechanism(self, engine: Any, body: int, panel_object: Mushroom, start: Start, effort_ratio: float) -> Spring:
        """A spring with a latch that no push frees."""
        return spring(engine, body, panel_object, start, effort_ratio, latching=True, releases=False)

    def print_on(self, canvas: Canvas, panel_object: Mushroom) -> None:
        """A yellow ground and the label."""
        canvas.disc(panel_object.position_m, panel_object.radius_m + 0.010, YELLOW)
        canvas.label(panel_object.position_m, panel_object.radius_m + 0.010, panel_object.label)

    def truth(self, panel_object: Mushroom, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Pressed or released; the value is the number of its presses."""
        return pressed(panel_object.name, mechanism)


BODY = MushroomBody()
