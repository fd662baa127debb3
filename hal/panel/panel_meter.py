"""Rectangular moving-coil meters."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from hal.panel.angles import PointerScale
from hal.panel.families import Rectangular
from hal.panel.parts import NotNegative, Positive
from hal.panel.questions import Question, Taught, about_a_pointer, pointer_scale

PIVOT_SHARE, NEEDLE_SHARE = 0.28, 0.6  # fractions of the height, for a meter that is taught


class PanelMeter(Rectangular):
    """Rectangular moving-coil meter; the pivot is `pivot_below_m` below the centre; positions are needle angles."""

    kind: Literal["panel_meter"] = "panel_meter"
    pivot_below_m: NotNegative
    needle_m: Positive
    scale: PointerScale
    depth_m: NotNegative = 0.004

    asked: ClassVar[tuple[Question, ...]] = about_a_pointer("-45", "45")

    @property
    def out_m(self) -> float:
        """How far its needle stands out of the plate, metres."""
        return self.depth_m

    @property
    def full_scale(self) -> float:
        """The difference between the highest and the lowest value of its scale."""
        return self.scale.span

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, needle and scale; pivot and needle have the usual proportions of such meters."""
        height = taught.size_m[1]
        below = round(PIVOT_SHARE * height, 4)
        return {
            **super().keys_of(taught),
            "pivot_below_m": below,
            "needle_m": round(NEEDLE_SHARE * height, 4),
            "scale": pointer_scale(taught, pivot_below_m=below),
        }
