"""Emergency stop mushroom: a wide head on a spring, which latches when pressed."""

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
    """Emergency stop that starts released."""

    def start(self, panel_object: Mushroom, u: float) -> Start:
        """Return the released state."""
        return Start()

    def model(self, panel_object: Mushroom, start: Start) -> ObjectModel:
        """Return head and stem."""
        r, h = panel_object.radius_m, panel_object.height_m
        head_m = 0.5 * h
        parts = [
            shape(at(0, 0, h - head_m / 2), cylinder(r, head_m), RED),
            shape(at(0, 0, h / 2 - 0.002), cylinder(0.5 * r, h - 0.004), RED),
        ]
        limits = (-panel_object.travel_m, 0.0)
        return ObjectModel(
            urdf=moving(parts, kind="prismatic", axis=(0, 0, 1), limits=limits, mass_kg=0.08, inertia_kg_m2=1e-4),
            has_exact_cylinders=True,
        )

    def mechanism(self, engine: Any, body: int, panel_object: Mushroom, start: Start, effort_ratio: float) -> Spring:
        """Return a spring with a latch that no push releases."""
        return spring(engine, body, panel_object, start, effort_ratio, latching=True, releases=False)

    def print_on(self, canvas: Canvas, panel_object: Mushroom) -> None:
        """Print a yellow background and the label."""
        canvas.disc(panel_object.position_m, panel_object.radius_m + 0.010, YELLOW)
        canvas.label(panel_object.position_m, panel_object.radius_m + 0.010, panel_object.label)

    def truth(self, panel_object: Mushroom, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return pressed or released; the value is the number of presses."""
        return pressed(panel_object.name, mechanism)


BODY = MushroomBody()
