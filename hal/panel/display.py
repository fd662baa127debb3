"""Seven-segment displays."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import model_validator

from hal.panel.families import Digits, about_digits
from hal.panel.goals import Shown
from hal.panel.questions import Question, Taught


class Display(Digits):
    """Seven-segment display."""

    kind: Literal["display"] = "display"
    style: Literal["led", "lcd"] = "led"

    asked: ClassVar[tuple[Question, ...]] = about_digits(
        "4", "9999", Question(key="style", text="Glowing or dark segments?", choices=("led", "lcd"), default="led")
    )

    @model_validator(mode="after")
    def _has_a_range(self) -> Display:
        if self.maximum <= self.minimum:
            raise ValueError("maximum must be greater than minimum")
        return self

    def is_right(self, said: Shown, truth: Shown) -> bool:
        """Return whether every character is right."""
        return said.text is not None and said.text.strip() == (truth.text or "").strip()

    @classmethod
    def keys_of(cls, taught: Taught) -> dict[str, Any]:
        """Return the keys for size, digits, style and range."""
        return {**super().keys_of(taught), "style": taught.text("style")}
