"""Quarter-turn lever valves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face
from hal.panel.goals import Shown, StateGoal
from hal.panel.parts import Positive, States, Vector2
from hal.panel.questions import PLACES, Question, Taught


class Lever(PanelObject):
    """Quarter-turn lever valve: a bar that turns about its hub."""

    kind: Literal["lever"] = "lever"
    length_m: Positive = 0.070
    width_m: Positive = 0.014
    height_m: Positive = 0.030
    states: States
    torque_nm: Positive = 2.0

    value_is_angle: ClassVar[bool] = True
    asked: ClassVar[tuple[Question, ...]] = (Question(key="states", text=PLACES, default="closed=90, open=0"),)
    turns_about_click: ClassVar[bool] = True

    @property
    def face(self) -> Face:
        """The area that its bar sweeps, in the plane of its top."""
        return Face(half_width_m=self.length_m, half_height_m=self.length_m, height_m=self.height_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half the sides of the area that its bar sweeps, including its end."""
        reach = self.length_m + self.width_m
        return reach, reach

    @property
    def half_foot_m(self) -> Vector2:
        """Half the sides of its hub; the bar may pass over lower parts."""
        return self.width_m / 2, self.width_m / 2

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box around all that it sweeps; at a known angle, around hub and bar only."""
        angle_rad = None if shown is None else self.angle_of(shown)
        if angle_rad is None:
            return Envelope(half_m=self.half_footprint_m, height_m=self.height_m)
        along = self.length_m / 2
        half = (self.width_m, along + self.width_m)
        return Envelope(half_m=half, height_m=self.height_m, turn_rad=-angle_rad, middle_m=(0.0, along))

    @property
    def goal(self) -> StateGoal:
        """One of its states."""
        return StateGoal(states=tuple(state.name for state in self.states))

    @property
    def resting_angles(self) -> Mapping[str, float]:
        """Angle of each state."""
        return {state.name: state.angle_rad for state in self.states}

    @property
    def mission_rank(self) -> float:
        """Rank before all other kinds."""
        return 1.0

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for length and states."""
        return {"length_m": round(taught.reach_m, 4), "states": taught.states("states")}
