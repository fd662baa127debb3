"""Space that an object occupies, and its visible edges and surfaces, all relative to its centre on the plate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Vector2 = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Face:
    """Part of an image that shows the object in any state: an upright rectangle, and the height above the plate of the
    plane in which its reader looks at it."""

    half_width_m: float
    half_height_m: float
    height_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rim:
    """Edge that is visible in every state: a circle of half the width, or a rectangle, at a height above the plate.

    Attributes:
        above_sigma_m: one standard deviation of `above_plate_m`, for an edge that is the object's foot in one view and its
            shoulder in another.
        reach_m: distance inside or outside of it within which a parallel edge of the same object may be stronger.
    """

    shape: Literal["circle", "rectangle"]
    width_m: float
    height_m: float
    above_plate_m: float = 0.0
    above_sigma_m: float = 0.0
    reach_m: float = 0.0


def circle(radius_m: float, *, above_plate_m: float = 0.0, above_sigma_m: float = 0.0, reach_m: float = 0.0) -> Rim:
    """Return a round rim."""
    return Rim(
        shape="circle",
        width_m=2.0 * radius_m,
        height_m=2.0 * radius_m,
        above_plate_m=above_plate_m,
        above_sigma_m=above_sigma_m,
        reach_m=reach_m,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """Box that stands on the plate and contains the object; nothing may enter it.

    Attributes:
        half_m: half its sides along its own axes.
        height_m: height above the plate.
        turn_rad: counter-clockwise rotation of its axes about the object's centre.
        middle_m: centre of the box relative to the object's centre, along the box's axes.
    """

    half_m: Vector2
    height_m: float
    turn_rad: float = 0.0
    middle_m: Vector2 = (0.0, 0.0)


CAP_SHARE = 0.25
"""One standard deviation of a cap's height and of its travel, relative to the travel: neither is known better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cap:
    """Round, flat cap that moves along the plate's normal: its height tells whether it is pressed or released.

    Attributes:
        radius_m: of the cap.
        height_m: of the released cap above the plate.
        pressed_depth_m: how much lower it is when it is read as pressed.
    """

    radius_m: float
    height_m: float
    pressed_depth_m: float

    def released_log_odds(self, height_m: float, sigma_m: float) -> float:
        """Return the log odds of `released` over `pressed` from a measured height above the plate, m."""
        depth_m = self.pressed_depth_m
        variance_m2 = sigma_m**2 + (CAP_SHARE * depth_m) ** 2
        return (height_m - (self.height_m - depth_m / 2)) * depth_m / variance_m2


@dataclass(frozen=True, slots=True, kw_only=True)
class Relief:
    """Surfaces of the object in a range image, and how they move.

    Attributes:
        surfaces: tables in the format of `perception.range`: name, type, point_m, direction, size_m and so on.
        height_m: height of the surfaces above the plate.
        motion: `slide` along the plate's normal by `low` to `high` metres, or `turn` about it by radians.
        turns: number of rotations in a full turn that look the same (3: every third of a turn); 0 if it is round.
        pressed_depth_m: for `slide`, how much lower the surfaces are when the object is read as pressed.
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
