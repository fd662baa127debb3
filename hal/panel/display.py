"""Seven-segment displays."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Rim
from hal.panel.gauge import LEAST_HEIGHT_M
from hal.panel.goals import Shown
from hal.panel.parts import Positive, Vector2
from hal.panel.questions import Question, Taught


class Display(PanelObject):
    """Seven-segment display."""

    kind: Literal["display"] = "display"
    width_m: Positive
    height_m: Positive
    digits: Annotated[int, Field(ge=1, le=8)]
    decimals: Annotated[int, Field(ge=0, le=7)] = 0
    style: Literal["led", "lcd"] = "led"
    unit: str = ""
    minimum: float = 0.0
    maximum: float = 9999.0

    asked: ClassVar[tuple[Question, ...]] = (
        Question(key="digits", text="How many digits?", default="4"),
        Question(key="decimals", text="How many of them after the point?", default="0"),
        Question(key="style", text="Glowing or dark segments?", choices=("led", "lcd"), default="led"),
        Question(key="unit", text="In which unit?"),
        Question(key="minimum", text="What is the least that it can show?", default="0"),
        Question(key="maximum", text="What is the most?", default="9999"),
    )

    @model_validator(mode="after")
    def _has_a_range(self) -> Display:
        if self.maximum <= self.minimum:
            raise ValueError("maximum must be greater than minimum")
        return self

    @property
    def face(self) -> Face:
        """Its frame, in the plane of the plate."""
        return Face(half_width_m=self.width_m / 2, half_height_m=self.height_m / 2, height_m=0.0)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of its frame."""
        return self.width_m / 2, self.height_m / 2

    def envelope(self, angle_rad: float | None = None) -> Envelope:
        """Return a flat box around the instrument."""
        return Envelope(half_m=self.half_footprint_m, height_m=LEAST_HEIGHT_M)

    @property
    def rim(self) -> Rim:
        """Its frame."""
        return Rim(shape="rectangle", width_m=self.width_m, height_m=self.height_m)

    @property
    def full_scale(self) -> float:
        """The difference between the largest and the smallest value that it may show."""
        return self.maximum - self.minimum

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Return whether every character is right."""
        return said.text is not None and said.text.strip() == (truth.text or "").strip()

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, digits and range."""
        width, height = taught.size_m
        return {
            "width_m": round(width, 4),
            "height_m": round(height, 4),
            **{key: round(taught.number(key)) for key in ("digits", "decimals")},
            "style": taught.text("style"),
            "unit": taught.text("unit"),
            **{key: taught.number(key) for key in ("minimum", "maximum")},
        }
