"""Selectors with detents."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from hal.panel.families import Barred
from hal.panel.form import Rim, circle
from hal.panel.goals import StateGoal
from hal.panel.parts import Positive, States
from hal.panel.questions import PLACES, Question, Taught


class Rotary(Barred):
    """Selector with detents."""

    kind: Literal["rotary"] = "rotary"
    height_m: Positive = 0.018
    states: States
    torque_nm: Positive = 0.15

    asked: ClassVar[tuple[Question, ...]] = (Question(key="states", text=PLACES, default="off=-45, on=45"),)

    @property
    def rim(self) -> Rim:
        """The knob's shoulder, at half its height; what is seen lies anywhere from its foot to its front."""
        return circle(self.radius_m, above_plate_m=self.height_m / 2, above_sigma_m=self.height_m / math.sqrt(12.0))

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
        return {**super().keys_of(taught), "states": taught.states("states")}
