"""Mechanical counters: digits on drums behind windows."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from hal.panel.families import Digits, about_digits
from hal.panel.goals import Shown
from hal.panel.questions import Question, Taught

DRUM_PITCH = 0.8
"""Distance between two digits round a drum, over the counter's height."""
RIGHT_STEPS = 0.25
"""How far a value may be from the drums' places, in steps of the last drum."""


class Counter(Digits):
    """Mechanical counter: one drum per digit, each in a window of its own, evenly spaced over the width.

    Counting up, the last drum turns gradually and its next digit comes up from below; a drum turns with the one on its
    right while that goes from 9 to 0. The value counts how far the last drum has turned; the text is the lower digits.
    """

    kind: Literal["counter"] = "counter"
    digits: Annotated[int, Field(ge=2, le=8)] = 5
    maximum: float = 99999.0
    ink: Literal["white", "black"] = "white"

    asked: ClassVar[tuple[Question, ...]] = about_digits(
        "5", "99999", Question(key="ink", text="White or black digits?", choices=("white", "black"), default="white")
    )

    @model_validator(mode="after")
    def _can_be_shown(self) -> Counter:
        if not 0 <= self.minimum < self.maximum:
            raise ValueError("maximum must be greater than minimum, and minimum at least 0: drums have no sign")
        if self.decimals >= self.digits:
            raise ValueError("at least one digit must stand before the point")
        return self

    @property
    def step(self) -> float:
        """What one digit of the last drum counts."""
        return 10.0**-self.decimals

    @property
    def pitch_m(self) -> float:
        """Distance between the middles of neighbouring windows."""
        return self.width_m / self.digits

    def text_of(self, count: int) -> str:
        """Return the digits of so many steps, with leading zeros, and the point."""
        text = f"{count:0{self.digits}d}"
        return f"{text[: -self.decimals]}.{text[-self.decimals :]}" if self.decimals else text

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Return whether the value is where the drums stand, to a quarter of the last drum's step."""
        if said.value is None or truth.value is None:
            return False
        return bool(abs(said.value - truth.value) <= RIGHT_STEPS * self.step)

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, digits, ink and range."""
        return {**super().keys_of(taught), "ink": taught.text("ink")}
