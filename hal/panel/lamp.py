"""Indicator lamps."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from hal.panel.families import Round
from hal.panel.form import Rim, circle
from hal.panel.parts import NotNegative
from hal.panel.questions import COLOURS, Question, Taught


class Lamp(Round):
    """Indicator lamp with states `on` and `off`."""

    kind: Literal["lamp"] = "lamp"
    colour: Literal["red", "green", "amber", "blue", "white"] = "green"
    height_m: NotNegative = 0.006

    can_be_lit: ClassVar[bool] = True
    asked: ClassVar[tuple[Question, ...]] = (
        Question(key="colour", text="Which colour?", choices=COLOURS, default="green"),
    )

    @property
    def states_shown(self) -> tuple[str, ...]:
        """States that a look can tell apart."""
        return "on", "off"

    @property
    def rim(self) -> Rim:
        """The foot of the lens; what is seen lies anywhere from there to its front."""
        return circle(self.radius_m, above_sigma_m=self.height_m / math.sqrt(3.0))

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and colour."""
        return {**super().keys_of(taught), "colour": taught.text("colour")}
