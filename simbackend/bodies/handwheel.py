"""Handwheel of a valve: rim, hub and spokes, one of them marked, turning with friction between two stops."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from hal.panel import Handwheel
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import WHITE, ObjectModel, moving
from simbackend.canvas import Canvas
from simbackend.mechanisms import TURN_DAMPING_NM_S_PER_RAD, Friction, Mechanism
from simbackend.urdf import Colour, along, at, cylinder, shape

SPREAD_RAD = 2.0
SEGMENTS = 20
BLUE: Colour = (0.10, 0.25, 0.55)


class HandwheelBody(Body[Handwheel]):
    """Handwheel that stays where it is turned."""

    def start(self, panel_object: Handwheel, u: float) -> Start:
        """Return an angle within two radians of upright."""
        low = max(panel_object.minimum_rad, -SPREAD_RAD)
        high = min(panel_object.maximum_rad, SPREAD_RAD)
        return Start(place=low + u * (high - low))

    def model(self, panel_object: Handwheel, start: Start) -> ObjectModel:
        """Return hub, rim of straight pieces, and spokes."""
        h, r, rim_m = panel_object.height_m, panel_object.radius_m, panel_object.rim_m
        ring_m = h - rim_m
        angles = np.linspace(0.0, 2 * np.pi, SEGMENTS + 1)
        points = [(r * math.sin(a), r * math.cos(a), ring_m) for a in angles]
        parts = [shape(at(0, 0, h / 2 - 0.001), cylinder(panel_object.hub_m, h - 0.002), BLUE)]
        for a_m, b_m in pairwise(points):
            middle, length_m = along(a_m, b_m)
            parts.append(shape(middle, cylinder(rim_m, length_m + 0.0015), BLUE))
        for i in range(panel_object.spokes):
            angle = 2 * math.pi * i / panel_object.spokes
            end = (r * math.sin(angle), r * math.cos(angle), ring_m)
            middle, length_m = along((0, 0, ring_m), end)
            # The marked spoke is white and wider than the others, so that the angle can be seen.
            colour, radius_m = (WHITE, 1.2 * panel_object.spoke_m) if i == 0 else (BLUE, panel_object.spoke_m)
            parts.append(shape(middle, cylinder(radius_m, length_m), colour))
        limits = (panel_object.minimum_rad, panel_object.maximum_rad)
        urdf = moving(parts, kind="revolute", axis=(0, 0, -1), limits=limits, mass_kg=0.3, inertia_kg_m2=4e-4)
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Handwheel, start: Start, effort_ratio: float) -> Friction:
        """Return friction between two stops."""
        effort = panel_object.torque_nm * effort_ratio
        return Friction(engine=engine, body=body, effort=effort, damping=TURN_DAMPING_NM_S_PER_RAD)

    def print_on(self, canvas: Canvas, panel_object: Handwheel) -> None:
        """Print the label."""
        canvas.label(panel_object.position_m, panel_object.radius_m + panel_object.rim_m, panel_object.label)

    def truth(self, panel_object: Handwheel, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the angle of the marked spoke."""
        return ObjectTruth(name=panel_object.name, value=place_of(mechanism))


BODY = HandwheelBody()
