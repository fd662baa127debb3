"""What kinds of one family share: round objects, rectangular ones, and those that show a number in digits."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from hal.panel.base import PanelObject
from hal.panel.form import Envelope, Face, Rim
from hal.panel.goals import Shown
from hal.panel.parts import NotNegative, Positive, Vector2
from hal.panel.questions import Question, Taught, radius_of

BAR_RATIO = 0.45
"""Usual width of a knob's bar divided by the knob's radius."""
LEAST_HEIGHT_M = 0.004
"""Height that is assumed for a flat instrument when collisions with the hand are avoided, in metres."""


class Round(PanelObject):
    """An object whose outline is a circle of `radius_m`; it stands `height_m` out of the plate."""

    radius_m: Positive
    height_m: NotNegative

    @property
    def face(self) -> Face:
        """The whole object, in the plane of its front."""
        return Face(half_width_m=self.radius_m, half_height_m=self.radius_m, height_m=self.height_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height, which are its radius."""
        return self.radius_m, self.radius_m

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box around the object."""
        return Envelope(half_m=self.half_footprint_m, height_m=max(self.height_m, LEAST_HEIGHT_M))

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the key for the radius."""
        return radius_of(taught)


class Barred(Round):
    """A round knob with a bar across it to take hold of."""

    bar_m: Annotated[Positive | None, Field(description="width of the bar; 0.45 of the radius if it is not given")] = (
        None
    )

    @property
    def bar_width_m(self) -> float:
        """Width of the bar."""
        return BAR_RATIO * self.radius_m if self.bar_m is None else self.bar_m


class Rectangular(PanelObject):
    """An object whose outline is an upright rectangle."""

    width_m: Positive
    height_m: Positive

    @property
    def out_m(self) -> float:
        """How far the plane in which it is read stands out of the plate, metres."""
        return 0.0

    @property
    def face(self) -> Face:
        """The whole object, in the plane in which it is read."""
        return Face(half_width_m=self.width_m / 2, half_height_m=self.height_m / 2, height_m=self.out_m)

    @property
    def half_footprint_m(self) -> Vector2:
        """Half width and half height of its outline."""
        return self.width_m / 2, self.height_m / 2

    def envelope(self, shown: Shown | None = None) -> Envelope:
        """Return a box around the object."""
        return Envelope(half_m=self.half_footprint_m, height_m=max(self.out_m, LEAST_HEIGHT_M))

    @property
    def rim(self) -> Rim:
        """Its outline on the plate."""
        return Rim(shape="rectangle", width_m=self.width_m, height_m=self.height_m)

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for width and height."""
        width, height = taught.size_m
        return {"width_m": round(width, 4), "height_m": round(height, 4)}


class Digits(Rectangular):
    """A rectangular instrument that shows a number from `minimum` to `maximum` in digits."""

    digits: Annotated[int, Field(ge=1, le=8)]
    decimals: Annotated[int, Field(ge=0, le=7)] = 0
    unit: str = ""
    minimum: float = 0.0
    maximum: float = 9999.0

    @property
    def full_scale(self) -> float:
        """The difference between the largest and the smallest value that it may show."""
        return self.maximum - self.minimum

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, digits and range."""
        return {
            **super().keys_of(taught),
            **{key: round(taught.number(key)) for key in ("digits", "decimals")},
            "unit": taught.text("unit"),
            **{key: taught.number(key) for key in ("minimum", "maximum")},
        }


def about_digits(digits: str, most: str, look: Question) -> tuple[Question, ...]:
    """Return the questions about an instrument with digits.

    Args:
        digits, most: usual answers for the number of digits and for the largest value.
        look: what is asked about how the digits look.
    """
    return (
        Question(key="digits", text="How many digits?", default=digits),
        Question(key="decimals", text="How many of them are after the decimal point?", default="0"),
        look,
        Question(key="unit", text="In which unit?"),
        Question(key="minimum", text="What is the smallest value that it can show?", default="0"),
        Question(key="maximum", text="What is the largest value that it can show?", default=most),
    )
