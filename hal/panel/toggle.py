"""Toggle switches."""

from __future__ import annotations

import math
from typing import Any, Literal

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face
from hal.panel.goals import Shown, StateGoal
from hal.panel.parts import Positive, Vector2
from hal.panel.questions import Taught
from hal.panel.turn import Tilt

SIDES = {"on": 1.0, "off": -1.0}  # up and down


class Toggle(PanelObject):
    """Two-way toggle switch; the bat tilts up or down by `tilt_rad`. States `on` (up) and `off` (down)."""

    kind: Literal["toggle"] = "toggle"
    bat_length_m: Positive = 0.020
    bat_radius_m: Positive = 0.004
    tilt_rad: Tilt = 0.40
    force_n: Positive = 6.0

    @property
    def states_shown(self) -> tuple[str, ...]:
        """States that a look can tell apart."""
        return "on", "off"

    @property
    def face(self) -> Face:
        """Nut and bat, which leans out of it; the height is that of its tip."""
        reach = self.bat_length_m * math.sin(self.tilt_rad) + self.bat_radius_m
        half_width = max(3.0 * self.bat_radius_m, 0.010)
        tip = self.bat_length_m * math.cos(self.tilt_rad)
        return Face(half_width_m=half_width, half_height_m=max(reach, half_width), height_m=tip)

    @property
    def half_foot_m(self) -> Vector2:
        """Half the sides of its nut."""
        return 1.8 * self.bat_radius_m, 1.8 * self.bat_radius_m

    @property
    def half_footprint_m(self) -> Vector2:
        """The length of its bat, which is the room that a finger needs around it."""
        return self.bat_length_m, self.bat_length_m

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box around the bat, which swings in the vertical plane; in a known state, around its side only."""
        foot, height = 2 * self.bat_radius_m, self.bat_length_m + self.bat_radius_m
        reach = self.bat_length_m * math.sin(self.tilt_rad) + foot
        side = SIDES.get(shown.state) if shown is not None and shown.state is not None else None
        if side is None:
            return Envelope(half_m=(foot, reach), height_m=height)
        return Envelope(half_m=(foot, (reach + foot) / 2), height_m=height, middle_m=(0.0, side * (reach - foot) / 2))

    @property
    def goal(self) -> StateGoal:
        """On or off."""
        return StateGoal(states=("on", "off"))

    @property
    def mission_rank(self) -> float:
        """Rank after levers, sliders and buttons."""
        return 4.0

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return no keys, because the outline says little about a bat that stands out of the plate."""
        return {}
