"""Simulated breaker: a handle with a latch; after a trip it holds at `on` only if it has been at `off` before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from acme_breaker.model import Breaker
from hal.simulated import ObjectTruth
from simbackend.bodies import (
    Body,
    Canvas,
    Detent,
    Mechanism,
    ObjectModel,
    Start,
    at,
    box,
    moving,
    place_of,
    shape,
)

PIVOT_M = 0.004
WHITE, BLUE = (0.95, 0.95, 0.95), (0.10, 0.18, 0.45)
HOUSING, EDGE, RECESS, SCREW, WHITE_INK = (226, 227, 222), (96, 98, 100), (40, 41, 44), (150, 152, 154), (235, 235, 235)
BORDER_M = 0.003
"""Width of the housing beside its dark recess."""


@dataclass(slots=True, eq=False)
class Latch(Detent):
    """Latch that rests at `on`, `off` or straight out; after a trip `on` holds only when `off` has been reached."""

    has_tripped: bool = False

    def nearest(self, x: float) -> float:
        """Return the resting place nearest to `x`."""
        low, high = self.places
        if self.has_tripped and x <= 0.8 * low:
            self.has_tripped = False
        places = (low, 0.0) if self.has_tripped else (low, high)
        return min(places, key=lambda place: abs(place - x))


class BreakerBody(Body[Breaker]):
    """Simulated body of a breaker in one of the states on, off and tripped."""

    def start(self, panel_object: Breaker, u: float) -> Start:
        """Return the initial state; each of the three has the same probability (`u` is uniform in [0, 1))."""
        return Start(place=(panel_object.tilt_rad, -panel_object.tilt_rad, 0.0)[int(3 * u)])

    def model(self, panel_object: Breaker, start: Start) -> ObjectModel:
        """Return the model of the handle with its bright tip."""
        reach, r, tilt = panel_object.bat_length_m, panel_object.bat_radius_m, panel_object.tilt_rad
        parts = [
            shape(at(0, 0, reach / 2 - r), box((2.5 * r, 1.2 * r, reach - 2 * r)), BLUE),
            shape(at(0, 0, reach - r), box((2.5 * r, 2 * r, 2 * r)), WHITE),
        ]
        urdf = moving(
            parts, kind="revolute", axis=(-1, 0, 0), limits=(-tilt, tilt), mass_kg=0.02, inertia_kg_m2=1e-4,
            pivot_m=(0, 0, PIVOT_M),
        )  # fmt: skip
        return ObjectModel(urdf=urdf, place=start.place)

    def mechanism(self, engine: Any, body: int, panel_object: Breaker, start: Start, effort_ratio: float) -> Latch:
        """Return the latch that makes the handle snap to its resting places."""
        effort = panel_object.force_n * panel_object.bat_length_m * effort_ratio
        ends = (-panel_object.tilt_rad, panel_object.tilt_rad)
        return Latch(
            engine=engine, body=body, places=ends, effort=effort, max_speed=8.0, has_tripped=start.place == 0.0
        )

    def print_on(self, canvas: Canvas, panel_object: Breaker) -> None:
        """Draw the light housing with its terminals, the dark recess that the handle moves in, I and O, and the label."""
        (x, y), w, h = panel_object.position_m, panel_object.width_m, panel_object.height_m
        recess_m = (w - 2 * BORDER_M, 0.76 * h)
        canvas.box((x, y), (w, h), EDGE)
        canvas.box((x, y), (w - 0.001, h - 0.001), HOUSING)
        canvas.box((x, y), recess_m, RECESS, round_m=0.001)
        for end, mark in ((0.44 * h, "I"), (-0.44 * h, "O")):
            canvas.disc((x, y + end), 0.0024, SCREW)
            canvas.line((x - 0.0015, y + end - 0.0015), (x + 0.0015, y + end + 0.0015), 0.0006, EDGE)
            canvas.text((x, y + 0.73 * end), mark, 0.004, WHITE_INK)
        canvas.label((x, y), h / 2, panel_object.label)

    def truth(self, panel_object: Breaker, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the true state from the place where the handle rests."""
        place = place_of(mechanism)
        states = {"on": panel_object.tilt_rad, "off": -panel_object.tilt_rad, "tripped": 0.0}
        return ObjectTruth(name=panel_object.name, state=min(states, key=lambda s: abs(states[s] - place)), value=place)


BODY = BreakerBody()
