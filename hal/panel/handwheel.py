"""Valve wheels with spokes."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Relief, Rim, circle
from hal.panel.goals import NumberGoal, Shown
from hal.panel.parts import Positive, Vector2
from hal.panel.questions import Question, Taught, radius_of
from hal.panel.turn import Turns

RIGHT_RAD = 0.105
"""Tolerance within which a wheel counts as read or turned correctly: 6 degrees, in radians."""


class Handwheel(PanelObject):
    """Valve wheel with spokes; turns between two stops. One spoke is marked and shows the angle."""

    kind: Literal["handwheel"] = "handwheel"
    radius_m: Positive = 0.035
    rim_m: Positive = 0.005
    height_m: Positive = 0.030
    spokes: Annotated[int, Field(ge=2, le=8)] = 3
    minimum_rad: Turns = -6.2832
    maximum_rad: Turns = 6.2832
    torque_nm: Positive = 0.8
    hub_m: Annotated[Positive, Field(description="radius of the hub")] = 0.009
    spoke_m: Annotated[Positive, Field(description="half the thickness of a spoke")] = 0.003

    starts_upright: Annotated[
        bool,
        Field(
            description="whether a wheel that has not been turned yet is within half a turn of 0; if not, its whole turns "
            "are unknown, and an angle that they could make ambiguous is refused"
        ),
    ] = True

    value_is_angle: ClassVar[bool] = True
    turns_round: ClassVar[bool] = True
    asked: ClassVar[tuple[Question, ...]] = (Question(key="spokes", text="How many spokes?", default="3"),)

    @model_validator(mode="after")
    def _can_turn(self) -> Handwheel:
        if self.maximum_rad <= self.minimum_rad:
            raise ValueError("maximum_rad must be greater than minimum_rad")
        return self

    @property
    def face(self) -> Face:
        """The wheel, in the plane of its rim's middle."""
        outer, ring = self.radius_m + self.rim_m, self.height_m - self.rim_m
        return Face(half_width_m=outer, half_height_m=outer, height_m=ring)

    @property
    def half_footprint_m(self) -> Vector2:
        """Its rim's outer radius."""
        return self.radius_m + self.rim_m, self.radius_m + self.rim_m

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box around the wheel."""
        return Envelope(half_m=self.half_footprint_m, height_m=self.height_m + self.rim_m)

    @property
    def rim(self) -> Rim:
        """The rim's outer edge."""
        return circle(self.radius_m + self.rim_m, above_plate_m=self.height_m - self.rim_m)

    @property
    def goal(self) -> NumberGoal:
        """An angle between its stops."""
        low, high = self.minimum_rad, self.maximum_rad
        return NumberGoal(key="angle_rad", low=low, high=high, unit="rad", tolerance=RIGHT_RAD)

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Return whether the marked spoke has the given angle, modulo whole turns."""
        if said.value is None or truth.value is None:
            return False
        return bool(abs((said.value - truth.value + math.pi) % (2 * math.pi) - math.pi) <= RIGHT_RAD)

    @property
    def relief(self) -> Relief:
        """A ring and spokes at the height of its tube's middle, on a hub."""
        up, ring_m = [0.0, 0.0, 1.0], self.height_m - self.rim_m
        rim = {
            "type": "torus",
            "point_m": [0, 0, ring_m],
            "direction": up,
            "size_m": self.radius_m,
            "tube_m": self.rim_m,
        }
        hub = {"type": "plane", "point_m": [0, 0, self.height_m], "direction": up, "size_m": self.hub_m}
        rows: list[dict[str, Any]] = [{"name": "rim", **rim}, {"name": "hub", **hub}]
        for k in range(self.spokes):
            angle = 0.5 * math.pi - 2.0 * math.pi * k / self.spokes  # the first points up, as the file counts angles
            x, y = math.cos(angle), math.sin(angle)
            middle = [0.5 * self.radius_m * x, 0.5 * self.radius_m * y, ring_m]
            size = {"size_m": self.spoke_m, "length_m": self.radius_m}
            rows.append(
                {"name": f"spoke_{k + 1}", "type": "cylinder", "point_m": middle, "direction": [x, y, 0.0], **size}
            )
        half_turn = math.pi / self.spokes
        surfaces = tuple({"tolerance_m": 0.001, **row} for row in rows)
        return Relief(
            surfaces=surfaces, height_m=self.height_m, motion="turn", low=-half_turn, high=half_turn, turns=self.spokes
        )

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and spokes."""
        return {**radius_of(taught), "spokes": round(taught.number("spokes"))}
