"""Knobs that turn continuously over a scale."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from hal.panel.angles import PointerScale
from hal.panel.families import Barred
from hal.panel.form import Rim, circle
from hal.panel.goals import NumberGoal
from hal.panel.parts import Positive
from hal.panel.questions import Question, Taught, about_a_pointer, pointer_scale


class Knob(Barred):
    """Knob without detents: a bar on it to take hold of, with a mark that points at a value of the scale around it."""

    kind: Literal["knob"] = "knob"
    radius_m: Positive = 0.016
    height_m: Positive = 0.018
    scale: PointerScale
    torque_nm: Positive = 0.1

    asked: ClassVar[tuple[Question, ...]] = about_a_pointer("-135", "135")

    @property
    def rim(self) -> Rim:
        """The knob's shoulder, at half its height; what is seen lies anywhere from its foot to its front."""
        return circle(self.radius_m, above_plate_m=self.height_m / 2, above_sigma_m=self.height_m / math.sqrt(12.0))

    @property
    def goal(self) -> NumberGoal:
        """A number on its scale."""
        return NumberGoal.on(self.scale)

    @property
    def mission_rank(self) -> float:
        """Rank after levers, sliders, buttons and toggles."""
        return 5.0

    @property
    def full_scale(self) -> float:
        """The difference between the highest and the lowest value of its scale."""
        return self.scale.span

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and scale."""
        return {**super().keys_of(taught), "scale": pointer_scale(taught)}
