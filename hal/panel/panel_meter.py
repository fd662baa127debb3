"""Rectangular moving-coil meters."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from hal.panel.angles import PointerScale
from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Rim
from hal.panel.gauge import LEAST_HEIGHT_M
from hal.panel.parts import NotNegative, Positive, Vector2
from hal.panel.questions import Question, Taught, about_a_pointer, pointer_scale

PIVOT_SHARE, NEEDLE_SHARE = 0.28, 0.6  # fractions of the height, for a meter that is taught


class PanelMeter(PanelObject):
    """Rectangular moving-coil meter; the pivot is `pivot_below_m` below the centre; positions are needle angles."""

    kind: Literal["panel_meter"] = "panel_meter"
    width_m: Positive
    height_m: Positive
    pivot_below_m: NotNegative
    needle_m: Positive
    scale: PointerScale
    depth_m: NotNegative = 0.004

    asked: ClassVar[tuple[Question, ...]] = about_a_pointer("-45", "45")

    @property
    def face(self) -> Face:
        """The whole instrument, in the plane of its needle."""
        return Face(half_width_m=self.width_m / 2, half_height_m=self.height_m / 2, height_m=self.depth_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of its frame."""
        return self.width_m / 2, self.height_m / 2

    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """Return a flat box around the instrument."""
        return Envelope(half_m=self.half_footprint_m, height_m=max(self.depth_m, LEAST_HEIGHT_M))

    @property
    def rim(self) -> Rim:
        """Its frame."""
        return Rim(shape="rectangle", width_m=self.width_m, height_m=self.height_m)

    @property
    def full_scale(self) -> float:
        """The difference between the highest and the lowest value of its scale."""
        return self.scale.span

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, needle and scale; pivot and needle have the usual proportions of such meters."""
        width, height = taught.size_m
        below = round(PIVOT_SHARE * height, 4)
        return {
            "width_m": round(width, 4),
            "height_m": round(height, 4),
            "pivot_below_m": below,
            "needle_m": round(NEEDLE_SHARE * height, 4),
            "scale": pointer_scale(taught, pivot_below_m=below),
        }
