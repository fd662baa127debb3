"""Push button: a cap on a spring, with an optional latch."""

from __future__ import annotations

from typing import Any

from hal.panel import Button, Mushroom
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start
from simbackend.bodies.parts import PAINT, ObjectModel, moving
from simbackend.canvas import RIM, Canvas
from simbackend.mechanisms import JOINT, Mechanism, Spring
from simbackend.urdf import at, cylinder, shape


class ButtonBody(Body[Button]):
    """Button that is out, or held in by its latch."""

    def start(self, panel_object: Button, u: float) -> Start:
        """Return a state; a latching button starts pressed with probability one half."""
        return Start(is_on=panel_object.latching and u < 0.5)

    def model(self, panel_object: Button, start: Start) -> ObjectModel:
        """Return the cap."""
        r, h, travel_m = panel_object.radius_m, panel_object.height_m, panel_object.travel_m
        cap = shape(at(0, 0, h / 2), cylinder(r, h), PAINT[panel_object.colour])
        limits = (-travel_m, 0.0)
        return ObjectModel(
            urdf=moving([cap], kind="prismatic", axis=(0, 0, 1), limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4),
            has_exact_cylinders=True,
        )

    def mechanism(self, engine: Any, body: int, panel_object: Button, start: Start, effort_ratio: float) -> Spring:
        """Return a spring; a second push releases a latched cap."""
        return spring(engine, body, panel_object, start, effort_ratio, latching=panel_object.latching, releases=True)

    def print_on(self, canvas: Canvas, panel_object: Button) -> None:
        """Print a dark bezel and the label."""
        canvas.disc(panel_object.position_m, panel_object.radius_m + 0.003, RIM)
        canvas.label(panel_object.position_m, panel_object.radius_m + 0.003, panel_object.label)

    def truth(self, panel_object: Button, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return pressed or released; the value is the number of presses."""
        return pressed(panel_object.name, mechanism)


def spring(
    engine: Any, body: int, cap: Button | Mushroom, start: Start, effort_ratio: float, *, latching: bool, releases: bool
) -> Spring:
    """Return the spring of a cap, latched if the cap started latched."""
    made = Spring(
        engine=engine,
        body=body,
        travel_m=cap.travel_m,
        spring_n_per_m=cap.spring_n_per_m * effort_ratio,
        preload_n=cap.preload_n * effort_ratio,
        latching=latching,
        releases=releases,
        is_latched=start.is_on,
    )
    if start.is_on:
        engine.resetJointState(body, JOINT, -made.latched_depth_m)
    return made


def pressed(name: str, mechanism: Mechanism | None) -> ObjectTruth:
    """Return the true state of a cap on a spring."""
    if not isinstance(mechanism, Spring):
        return ObjectTruth(name=name)
    is_pressed = mechanism.is_latched or mechanism.is_in
    return ObjectTruth(name=name, state="pressed" if is_pressed else "released", value=float(mechanism.presses))


BODY = ButtonBody()
