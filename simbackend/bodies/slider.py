"""Slider: a cap that moves along a straight track with friction."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.panel import Slider
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import KNOB, WHITE, ObjectModel, moving
from simbackend.canvas import RIM, Canvas
from simbackend.mechanisms import SLIDE_DAMPING_N_S_PER_M, Friction, Mechanism
from simbackend.urdf import at, box, shape

LIFT_M = 0.0005


class SliderBody(Body[Slider]):
    """Slider whose cap stays where it is pushed."""

    def start(self, panel_object: Slider, u: float) -> Start:
        """Return a value away from the ends of the scale."""
        scale = panel_object.scale
        value = scale.minimum + (0.1 + 0.8 * u) * (scale.maximum - scale.minimum)
        return Start(place=scale.place_of(value), value=value)

    def model(self, panel_object: Slider, start: Start) -> ObjectModel:
        """Return the cap, with a white line across it."""
        sx, sy, sz = panel_object.cap_size_m
        angle_rad, travel_m = panel_object.angle_rad, panel_object.travel_m
        turn = RigidTransform.from_rotation(Rotation.from_euler("z", angle_rad))
        parts = [
            shape(turn * at(0, 0, sz / 2 + LIFT_M), box((sx, sy, sz)), KNOB),
            shape(turn * at(0, 0, sz + LIFT_M), box((0.0016, sy, 0.0006)), WHITE, collision=False),
        ]
        axis = (math.cos(angle_rad), math.sin(angle_rad), 0.0)
        limits = (-travel_m / 2, travel_m / 2)
        urdf = moving(parts, kind="prismatic", axis=axis, limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4)
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Slider, start: Start, effort_ratio: float) -> Friction:
        """Return friction between the ends of the track."""
        effort = panel_object.friction_n * effort_ratio
        return Friction(engine=engine, body=body, effort=effort, damping=SLIDE_DAMPING_N_S_PER_M)

    def print_on(self, canvas: Canvas, panel_object: Slider) -> None:
        """Print slot, ticks and numerals."""
        c, s = math.cos(panel_object.angle_rad), math.sin(panel_object.angle_rad)

        def point(along_m: float, across_m: float) -> tuple[float, float]:
            x, y = panel_object.position_m
            return (x + along_m * c - across_m * s, y + along_m * s + across_m * c)

        half_m = panel_object.travel_m / 2 + panel_object.cap_size_m[0] / 2
        canvas.polygon(
            [point(-half_m, -0.002), point(half_m, -0.002), point(half_m, 0.002), point(-half_m, 0.002)], RIM
        )
        edge_m, scale = panel_object.cap_size_m[1] / 2 + 0.002, panel_object.scale
        for value in np.linspace(scale.minimum, scale.maximum, scale.major_ticks):
            place_m = scale.place_of(float(value))
            canvas.line(point(place_m, edge_m), point(place_m, edge_m + 0.005), 0.0009)
            canvas.text(point(place_m, edge_m + 0.010), f"{value:g}", 0.0042)
        canvas.text(point(0.0, -edge_m - 0.009), f"{panel_object.label} {scale.unit}".strip(), 0.0052)

    def truth(self, panel_object: Slider, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the value at the centre of the cap."""
        return ObjectTruth(name=panel_object.name, value=panel_object.scale.value_at(place_of(mechanism)))


BODY = SliderBody()
