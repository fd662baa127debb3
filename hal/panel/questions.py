"""Questions about an object when a panel is taught, and the answers as its kind needs them.

Angles are asked for in degrees, and panel files are written in degrees (`at_min_deg`, `angle_deg`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

COLOURS = ("green", "red", "amber", "blue", "white")
MARKS = "degrees clockwise from straight up, or x,y of a pixel on the mark"
PLACES = "What are its positions (name=degrees clockwise from straight up, separated by commas)?"


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """Question of the dialogue; `choices` is empty if any text or number is allowed; `default` if unanswered."""

    key: str
    text: str
    choices: tuple[str, ...] = ()
    default: str = ""


class Taught(Protocol):
    """Object that a user has clicked on and described: its outline in the image, and the answers about it."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the outline on the plate, in metres."""
        ...

    @property
    def reach_m(self) -> float:
        """Distance in metres from the clicked point to the far end of the outline."""
        ...

    def text(self, key: str) -> str:
        """Return the answer to a question.

        Raises:
            InvalidRequest: the answer is not one of the question's choices.
        """
        ...

    def number(self, key: str) -> float:
        """Return the answer to a question as a number.

        Raises:
            InvalidRequest: the answer is not a number.
        """
        ...

    def mark_deg(self, key: str, *, pivot_below_m: float = 0.0) -> float:
        """Return the answer as an angle in degrees clockwise from straight up, about a pivot below the object's centre.

        Raises:
            InvalidRequest: the answer is neither an angle nor a pixel.
        """
        ...

    def states(self, key: str) -> list[dict[str, Any]]:
        """Return the answer as named states: tables of the panel file with `name` and `angle_deg`.

        Raises:
            InvalidRequest: an angle is not a number.
        """
        ...


ENDS = (
    Question(key="minimum", text="Which value stands at the low end of the scale?", default="0"),
    Question(key="maximum", text="Which value stands at the high end?", default="10"),
    Question(key="unit", text="In which unit?", default="bar"),
)


def about_a_pointer(low_deg: str, high_deg: str) -> tuple[Question, ...]:
    """Return the questions about a scale whose positions are angles."""
    return (
        *ENDS,
        Question(key="at_min", text=f"Where is the low end ({MARKS})?", default=low_deg),
        Question(key="at_max", text=f"Where is the high end ({MARKS})?", default=high_deg),
    )


def ends_of(taught: Taught) -> dict[str, Any]:
    """Return the smallest and the largest value of a scale, and its unit."""
    return {"minimum": taught.number("minimum"), "maximum": taught.number("maximum"), "unit": taught.text("unit")}


def pointer_scale(taught: Taught, *, pivot_below_m: float = 0.0) -> dict[str, Any]:
    """Return the answers about a scale whose positions are angles, as a table of the panel file."""
    at_min, at_max = (taught.mark_deg(key, pivot_below_m=pivot_below_m) for key in ("at_min", "at_max"))
    return {**ends_of(taught), "at_min_deg": at_min, "at_max_deg": at_max}


def radius_of(taught: Taught) -> dict[str, Any]:
    """Return the key for the radius of a round object's outline."""
    return {"radius_m": round(sum(taught.size_m) / 4, 4)}
