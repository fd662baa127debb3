"""Selectors with detents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Rim, circle
from hal.panel.goals import StateGoal
from hal.panel.parts import Positive, States, Vector2
from hal.panel.questions import PLACES, Question, Taught, radius_of


class Rotary(PanelObject):
    """Selector with detents."""

    kind: Literal["rotary"] = "rotary"
    radius_m: Positive
    height_m: Positive = 0.018
    states: States
    torque_nm: Positive = 0.15

    asked: ClassVar[tuple[Question, ...]] = (Question(key="states", text=PLACES, default="off=-45, on=45"),)

    @property
    def face(self) -> Face:
        """The knob, in the plane of its front."""
        return Face(half_width_m=self.radius_m, half_height_m=self.radius_m, height_m=self.height_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height, which are its radius."""
        return self.radius_m, self.radius_m

    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """Return a box around the knob."""
        return Envelope(half_m=self.half_footprint_m, height_m=self.height_m)

    @property
    def rim(self) -> Rim:
        """The knob's shoulder, at half its height."""
        return circle(self.radius_m, above_plate_m=self.height_m / 2)

    @property
    def goal(self) -> StateGoal:
        """One of its states."""
        return StateGoal(states=tuple(state.name for state in self.states))

    @property
    def resting_angles(self) -> Mapping[str, float]:
        """Angle of each detent."""
        return {state.name: state.angle_rad for state in self.states}

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and states."""
        return {**radius_of(taught), "states": taught.states("states")}
