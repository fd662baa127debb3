"""Indicator lamps."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Rim, circle
from hal.panel.gauge import LEAST_HEIGHT_M
from hal.panel.parts import NotNegative, Positive, Vector2
from hal.panel.questions import COLOURS, Question, Taught, radius_of


class Lamp(PanelObject):
    """Indicator lamp with states `on` and `off`."""

    kind: Literal["lamp"] = "lamp"
    radius_m: Positive
    colour: Literal["red", "green", "amber", "blue", "white"] = "green"
    height_m: NotNegative = 0.006

    asked: ClassVar[tuple[Question, ...]] = (
        Question(key="colour", text="Which colour?", choices=COLOURS, default="green"),
    )

    @property
    def face(self) -> Face:
        """The lens, in the plane of its front."""
        return Face(half_width_m=self.radius_m, half_height_m=self.radius_m, height_m=self.height_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height, which are its radius."""
        return self.radius_m, self.radius_m

    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """Return a box around the lens."""
        return Envelope(half_m=self.half_footprint_m, height_m=max(self.height_m, LEAST_HEIGHT_M))

    @property
    def rim(self) -> Rim:
        """The foot of the lens."""
        return circle(self.radius_m)

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and colour."""
        return {**radius_of(taught), "colour": taught.text("colour")}
