"""Round pointer instruments."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from hal.panel.angles import PointerScale
from hal.panel.base import PanelObject
from hal.panel.families import LEAST_HEIGHT_M
from hal.panel.form import Envelope, Face, Rim, circle
from hal.panel.goals import Shown
from hal.panel.parts import NotNegative, Positive, Vector2
from hal.panel.questions import Question, Taught, about_a_pointer, pointer_scale, radius_of


class Gauge(PanelObject):
    """Round pointer instrument; the positions of its scale are needle angles."""

    kind: Literal["gauge"] = "gauge"
    radius_m: Positive
    scale: PointerScale
    depth_m: NotNegative = 0.004

    asked: ClassVar[tuple[Question, ...]] = about_a_pointer("-135", "135")

    @property
    def face(self) -> Face:
        """The whole instrument, in the plane of its needle."""
        return Face(half_width_m=self.radius_m, half_height_m=self.radius_m, height_m=self.depth_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height, which are its radius."""
        return self.radius_m, self.radius_m

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a flat box around the instrument."""
        return Envelope(half_m=self.half_footprint_m, height_m=max(self.depth_m, LEAST_HEIGHT_M))

    @property
    def rim(self) -> Rim:
        """The rim lies at the plate; only the needle stands `depth_m` above it. The face begins inside the rim."""
        return circle(self.radius_m, reach_m=0.12 * self.radius_m)

    @property
    def full_scale(self) -> float:
        """The difference between the highest and the lowest value of its scale."""
        return self.scale.span

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for radius and scale."""
        return {**radius_of(taught), "scale": pointer_scale(taught)}
