"""The room that an object takes, and the edges and surfaces that it shows, all relative to its middle on the plate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Vector2 = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Face:
    """The part of a picture that shows the object in any state: an upright rectangle, and the height above the plate of the
    plane in which its reader looks at it."""

    half_width_m: float
    half_height_m: float
    height_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rim:
    """An edge that every state shows: a circle of half the width, or a rectangle, at a height above the plate.

    Attributes:
        reach_m: how far inside or outside of it a parallel edge of the same object may be the stronger one.
    """

    shape: Literal["circle", "rectangle"]
    width_m: float
    height_m: float
    above_plate_m: float = 0.0
    reach_m: float = 0.0


def circle(radius_m: float, *, above_plate_m: float = 0.0, reach_m: float = 0.0) -> Rim:
    """Return a round rim."""
    size = 2.0 * radius_m
    return Rim(shape="circle", width_m=size, height_m=size, above_plate_m=above_plate_m, reach_m=reach_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """A box that stands on the plate and holds the object: nothing may touch what is inside.

    Attributes:
        half_m: half its sides along its own axes.
        height_m: how far it stands out of the plate.
        turn_rad: counter-clockwise turn of its axes about the object's middle.
        middle_m: the box's middle from the object's middle, along its own axes.
    """

    half_m: Vector2
    height_m: float
    turn_rad: float = 0.0
    middle_m: Vector2 = (0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Relief:
    """How a range image shows the object: surfaces, and how they move.

    Attributes:
        surfaces: tables as `perception.range` takes them: name, type, point_m, direction, size_m and so on.
        height_m: how far they stand out of the plate.
        motion: `slide` out of the plate by `low` to `high` metres, or `turn` about the plate's normal by radians.
        turns: the object looks alike after this share of a turn (3: after a third); 0 when it is round.
        pressed_depth_m: of what slides: how much lower it is where it is read as pressed.
    """

    surfaces: tuple[dict[str, Any], ...]
    height_m: float
    motion: Literal["slide", "turn"]
    low: float
    high: float
    turns: int = 0
    pressed_depth_m: float = 0.0

    def state_name(self, state: float) -> str:
        """Return the name of the state after a slide by `state` metres."""
        return "pressed" if state < -0.5 * self.pressed_depth_m else "released"

    def table(self) -> dict[str, Any]:
        """Return the model as a table for `perception.range`."""
        axis = {"motion_axis": [0.0, 0.0, 1.0]} if self.motion == "slide" else {}
        surfaces = list(self.surfaces)
        return {
            "turns": self.turns,
            "motion": self.motion,
            "low": self.low,
            "high": self.high,
            **axis,
            "surfaces": surfaces,
        }
