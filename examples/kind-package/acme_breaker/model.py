"""Model of a breaker in a panel file."""

from __future__ import annotations

import math
from typing import Any, Literal

from hal.panel import Envelope, Face, PanelObject, Positive, Rim, StateGoal, Taught, Vector2


class Breaker(PanelObject):
    """Circuit breaker: its handle leans up (`on`) or down (`off`), or stands straight out (`tripped`).

    A tripped breaker must be switched to `off` before it can be switched to `on`.
    """

    kind: Literal["breaker"] = "breaker"
    width_m: Positive = 0.026
    height_m: Positive = 0.060
    bat_length_m: Positive = 0.020
    bat_radius_m: Positive = 0.004
    tilt_rad: Positive = 0.45
    force_n: Positive = 6.0

    @property
    def face(self) -> Face:
        """The housing; the height is that of the handle's tip when it leans."""
        tip = self.bat_length_m * math.cos(self.tilt_rad)
        return Face(half_width_m=self.width_m / 2, half_height_m=self.height_m / 2, height_m=tip)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of the housing."""
        return self.width_m / 2, self.height_m / 2

    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """Return a box over the housing, as high as a handle that stands straight out."""
        return Envelope(half_m=self.half_footprint_m, height_m=self.bat_length_m + 2 * self.bat_radius_m)

    @property
    def rim(self) -> Rim:
        """Outline of the housing on the plate."""
        return Rim(shape="rectangle", width_m=self.width_m, height_m=self.height_m)

    @property
    def goal(self) -> StateGoal:
        """The states `on` and `off`; only a fault in its circuit trips a breaker."""
        return StateGoal(states=("on", "off"))

    @property
    def mission_rank(self) -> float:
        """Rank after all other kinds."""
        return 6.0

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for width and height, from the outline."""
        width, height = taught.size_m
        return {"width_m": round(width, 4), "height_m": round(height, 4)}
