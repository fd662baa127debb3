"""Building blocks of the kinds' models: numbers that must be positive, lights, scales and named states."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from hal.panel.turn import Angle, meant_otherwise
from hal.strict import Strict

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]

LATCHED_SHARE = 0.6
"""Fraction of its travel that a latched cap stays pressed in."""


class Light(Strict):
    """Border light: a lamp whose centre is known."""

    name: Name
    position_m: Vector3
    radius_m: Positive = 0.008


TagFamily = Literal["16h5", "25h9", "36h10", "36h11"]
QUIET_SHARE = 0.125
"""Width of the white border around a tag's black square that the layout keeps free, as a share of the square's side."""


class Tag(Strict):
    """Printed AprilTag: a black square with a code, by which a camera finds the panel without border lights."""

    id: Annotated[int, Field(ge=0, le=2319, description="number of the tag within its family")]
    family: Annotated[TagFamily, Field(description="AprilTag family; 36h11 is read with the fewest mistakes")] = "36h11"
    size_m: Annotated[
        float, Field(gt=0.005, le=1.0, description="side of the printed black square, without its border")
    ]
    position_m: Annotated[
        Vector3, Field(description="middle of the square (x, y) and height of the print above the plate (z)")
    ]
    angle_rad: Annotated[Angle, Field(description="turn of the print, clockwise as the viewer sees it")] = 0.0

    @property
    def name(self) -> str:
        """Name in reports and errors, for example `tag_36h11_4`."""
        return f"tag_{self.family}_{self.id}"

    @property
    def half_foot_m(self) -> float:
        """Half the side of the square with its white border."""
        return (0.5 + QUIET_SHARE) * self.size_m

    @property
    def corners_m(self) -> tuple[Vector3, ...]:
        """Corners of the black square in the panel frame, upper left of the upright print first and clockwise."""
        x, y, z = self.position_m
        c, s, half = math.cos(self.angle_rad), math.sin(self.angle_rad), self.size_m / 2
        around = ((-half, half), (half, half), (half, -half), (-half, -half))
        return tuple((x + c * u + s * v, y - s * u + c * v, z) for u, v in around)


class Scale(Strict):
    """Scale: how an angle (or a length) shows a value.

    `at_min` and `at_max` are the pointer's positions at `minimum` and `maximum`; `table` holds further (position,
    value) pairs of a scale that is not linear, in rising order of position.
    """

    minimum: float
    maximum: float
    unit: str
    at_min: float
    at_max: float
    major_ticks: Annotated[int, Field(ge=2, le=50)] = 6
    table: tuple[Vector2, ...] = ()

    @model_validator(mode="after")
    def _is_a_scale(self) -> Scale:
        if self.maximum <= self.minimum:
            raise meant_otherwise(
                f"maximum must be greater than minimum, and {self.maximum:g} is not greater than {self.minimum:g}",
                "swap them; if the values decrease along the scale, swap at_min and at_max instead",
            )
        if self.at_max == self.at_min:
            raise meant_otherwise(
                f"at_max must differ from at_min, and both are {self.at_min:g}", "give the position of each end"
            )
        steps = [(p1 - p0, v1 - v0) for (p0, v0), (p1, v1) in pairwise(self._points())]
        if any(place == 0.0 or value == 0.0 or (value > 0.0) != (steps[0][1] > 0.0) for place, value in steps):
            raise meant_otherwise(
                "the values of a scale and its table must all rise, or all fall, from place to place",
                "correct the pair of the table that is out of order with its neighbours",
            )
        return self

    @property
    def span(self) -> float:
        """The difference between the highest and the lowest value."""
        return self.maximum - self.minimum

    def value_at(self, place: float) -> float:
        """Return the value at a position (rad or m), linear between the pairs and extrapolated beyond the ends."""
        points = self._points()
        for (p0, v0), (p1, v1) in pairwise(points):
            if place <= p1 or (p1, v1) == points[-1]:
                return v0 + (place - p0) * (v1 - v0) / (p1 - p0)
        raise AssertionError("a scale has two points")

    def place_of(self, value: float) -> float:
        """Return the position (rad or m) of a value, the inverse of `value_at`."""
        points = sorted((v, p) for p, v in self._points())
        for (v0, p0), (v1, p1) in pairwise(points):
            if value <= v1 or (v1, p1) == points[-1]:
                return p0 + (value - v0) * (p1 - p0) / (v1 - v0)
        raise AssertionError("a scale has two points")

    def _points(self) -> list[Vector2]:
        return sorted([(self.at_min, self.minimum), *self.table, (self.at_max, self.maximum)])


class State(Strict):
    """Named resting position of a control; `angle_rad` is clockwise from straight up (toggle: tilt, up is positive)."""

    name: Name
    angle_rad: Angle = 0.0


def _all_different(states: tuple[State, ...]) -> tuple[State, ...]:
    if len({state.name for state in states}) != len(states):
        raise meant_otherwise("two states have the same name", "rename one, or leave it out")
    return states


States = Annotated[tuple[State, ...], Field(min_length=2), AfterValidator(_all_different)]
