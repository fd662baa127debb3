"""Model of a breaker in a panel file."""

from __future__ import annotations

import math
from typing import Literal

from hal.panel import Envelope, Positive, Rectangular, Shown, StateGoal, Tilt


class Breaker(Rectangular):
    """Circuit breaker: its handle leans up (`on`) or down (`off`), or stands straight out (`tripped`).

    A tripped breaker must be switched to `off` before it can be switched to `on`.
    """

    kind: Literal["breaker"] = "breaker"
    width_m: Positive = 0.026
    height_m: Positive = 0.060
    bat_length_m: Positive = 0.020
    bat_radius_m: Positive = 0.004
    tilt_rad: Tilt = 0.45
    force_n: Positive = 6.0

    @property
    def out_m(self) -> float:
        """Height above the plate of the handle's tip when it leans: the plane in which it is read."""
        return self.bat_length_m * math.cos(self.tilt_rad)

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box over the housing, as high as a handle that stands straight out."""
        return Envelope(half_m=self.half_footprint_m, height_m=self.bat_length_m + 2 * self.bat_radius_m)

    @property
    def goal(self) -> StateGoal:
        """The states `on` and `off`; only a fault in its circuit trips a breaker."""
        return StateGoal(states=("on", "off"))

    @property
    def mission_rank(self) -> float:
        """Rank after all other kinds."""
        return 6.0
