"""Sliders on straight tracks."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from pydantic import ValidationError, model_validator

from hal.panel.angles import fault
from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face
from hal.panel.goals import GAUGE_SHARE, NumberGoal, Shown
from hal.panel.parts import Positive, Scale, Vector2, Vector3
from hal.panel.questions import ENDS, Question, Taught, ends_of
from hal.panel.turn import Angle

CAP_M = 0.012  # length of the cap along its track, for a slider that is taught


class Slider(PanelObject):
    """Slider on a straight track; positions of its scale are metres from the track's centre, `angle_rad` from +x."""

    kind: Literal["slider"] = "slider"
    angle_rad: Angle = 0.0
    travel_m: Positive
    cap_size_m: Vector3 = (0.012, 0.024, 0.016)  # along the track, across it, out of the plate
    scale: Scale
    friction_n: Positive = 4.0

    places_are_lengths: ClassVar[bool] = True
    asked: ClassVar[tuple[Question, ...]] = (
        *ENDS,
        Question(
            key="rises",
            text="In which direction does the value increase?",
            choices=("right", "left", "up", "down"),
            default="right",
        ),
    )

    @model_validator(mode="after")
    def _places_are_on_the_track(self) -> Slider:
        """Check that the scale's positions are metres along the track."""
        faults = [
            fault(
                ("scale", key),
                place,
                f"{place:g} m is beyond the track",
                f"the track ends {self.travel_m / 2:g} m from its middle",
            )
            for key, place in (("at_min", self.scale.at_min), ("at_max", self.scale.at_max))
            if abs(place) > 0.501 * self.travel_m
        ]
        if faults:
            raise ValidationError.from_exception_data("slider", faults)
        return self

    @property
    def half_footprint_m(self) -> Vector2:
        """The cap at any place of its track."""
        along = self.travel_m / 2 + self.cap_size_m[0] / 2
        across = self.cap_size_m[1] / 2
        c, s = abs(math.cos(self.angle_rad)), abs(math.sin(self.angle_rad))
        return along * c + across * s, along * s + across * c

    @property
    def half_foot_m(self) -> Vector2:
        """The cap at any place of its track, along the track and across it."""
        return self.envelope().half_m

    @property
    def face(self) -> Face:
        """Track and cap, in the plane of the cap's top."""
        half_width, half_height = self.half_footprint_m
        return Face(half_width_m=half_width, half_height_m=half_height, height_m=self.cap_size_m[2])

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box along the track; at a known value, around the cap where that may be."""
        along, across, out = self.cap_size_m
        if shown is None or shown.value is None:
            half = ((self.travel_m + along) / 2, across / 2)
            return Envelope(half_m=half, height_m=out, turn_rad=self.angle_rad)
        half = (along / 2 + GAUGE_SHARE * self.travel_m, across / 2)
        middle = (self.scale.place_of(shown.value), 0.0)
        return Envelope(half_m=half, height_m=out, turn_rad=self.angle_rad, middle_m=middle)

    @property
    def goal(self) -> NumberGoal:
        """A number on its scale."""
        return NumberGoal.on(self.scale)

    @property
    def mission_rank(self) -> float:
        """Rank after levers."""
        return 2.0

    @property
    def full_scale(self) -> float:
        """The difference between the highest and the lowest value of its scale."""
        return self.scale.span

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for travel and scale, from the outline of track and cap."""
        rises = taught.text("rises")
        is_flat = rises in ("right", "left")
        travel = round(max(taught.size_m[0 if is_flat else 1] - CAP_M, 0.01), 4)
        sign = 1.0 if rises in ("right", "up") else -1.0
        scale = {**ends_of(taught), "at_min": -sign * travel / 2, "at_max": sign * travel / 2}
        return {"angle_deg": 0.0 if is_flat else 90.0, "travel_m": travel, "scale": scale}
