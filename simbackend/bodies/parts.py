"""Building blocks of simulated bodies: URDF links, printed pictures, shining parts.

All coordinates are in panel axes from the object's centre on the plate (z out of the plate). Joint positions are
positive clockwise, along the track, or out of the plate. Instrument faces lie 1 mm above the plate.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hal.panel import Light, State
from simbackend.urdf import Colour, at, box, cylinder, inertial, joint, link, shape

LENS_M = 0.0004
FACE_HEIGHT_M = 0.001
STATE_SLACK_RAD = 0.2
INK: Colour = (0.10, 0.10, 0.11)
KNOB: Colour = (0.13, 0.13, 0.15)
WHITE: Colour = (0.95, 0.95, 0.95)
STEEL: Colour = (0.80, 0.81, 0.83)
RED: Colour = (0.80, 0.08, 0.07)
PAINT: dict[str, Colour] = {
    "red": RED,
    "green": (0.06, 0.55, 0.16),
    "amber": (0.90, 0.55, 0.05),
    "blue": (0.08, 0.22, 0.70),
    "white": (0.90, 0.90, 0.88),
    "black": (0.08, 0.08, 0.09),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Quad:
    """Flat picture; `round` ones are discs. Centre and size in the object's axes, metres."""

    pixels: NDArray[np.uint8]
    size_m: tuple[float, float]
    centre_m: tuple[float, float, float]
    is_round: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Shine:
    """Lens that lights up: its colour by name (see `PAINT`), radius and height of its front, m."""

    colour: str
    radius_m: float
    height_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectModel:
    """Model of one object, as loaded by the world.

    Attributes:
        urdf: lines with the base link `base` and at most one moving joint; none for a body that is only printed.
        quads: printed pictures.
        place: initial position of the joint.
        shine: how the base lights up, for an object that can.
        has_exact_cylinders: whether cylinders are met where they are seen. The engine replaces others by prisms that are
            met 1 mm outside of them, which is a third of the way of a latch.
    """

    urdf: list[str] = field(default_factory=list)
    quads: tuple[Quad, ...] = ()
    place: float = 0.0
    shine: Shine | None = None
    has_exact_cylinders: bool = False


def light_urdf(light: Light) -> str:
    """Return a border light: a dark holder (base) with a thin lens (link 0) whose face is at the light's position.

    If the whole body shone, its side would shift the centre of the spot by half a pixel in an oblique view.
    """
    low_m = max(light.position_m[2] - LENS_M, 1e-4)
    lines = base(shape(at(0, 0, low_m / 2), cylinder(light.radius_m, low_m), INK))
    lines += link(
        "lens",
        inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0)),
        shape(at(0, 0, LENS_M / 2), cylinder(light.radius_m, LENS_M), STEEL),
    )
    return robot([*lines, *joint("lens", "fixed", "base", "lens", at(0, 0, low_m))])


def robot(lines: list[str]) -> str:
    """Return the complete URDF text."""
    return "\n".join(['<robot name="part">', *lines, "</robot>"])


def base(*parts: list[str]) -> list[str]:
    """Return the link that is fixed to the plate."""
    return link("base", inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0)), *parts)


def disc(radius_m: float, height_m: float, colour: Colour) -> list[str]:
    """Return a base that is one round block."""
    return base(shape(at(0, 0, height_m / 2), cylinder(radius_m, height_m), colour))


def moving(
    parts: list[list[str]],
    *,
    kind: str,
    axis: tuple[float, float, float],
    limits: tuple[float, float],
    mass_kg: float,
    inertia_kg_m2: float,
    pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    fixed: list[list[str]] | None = None,
) -> list[str]:
    """Return a part on a joint: `kind` is `revolute` or `prismatic`, `limits` are its end stops (rad or m)."""
    lines = base(*(fixed or []))
    lines += link("part", inertial(mass_kg, (0, 0, 0), (inertia_kg_m2,) * 3), *parts)
    return lines + joint("part", kind, "base", "part", at(*pivot_m), axis=axis, limits=limits)


def needle(*, length_m: float, tail_m: float, width_m: float, height_m: float, pivot_y_m: float) -> list[str]:
    """Return the needle of an instrument, which turns about a pivot above or below the object's centre."""
    middle_m = (length_m - tail_m) / 2
    parts = [
        shape(at(0, middle_m, 0), box((width_m, length_m + tail_m, 0.0006)), INK, collision=False),
        shape(at(0, 0, 0), cylinder(1.8 * width_m, 0.0012), INK, collision=False),
    ]
    return moving(
        parts,
        kind="revolute",
        axis=(0, 0, -1),
        limits=(-7.0, 7.0),
        mass_kg=0.002,
        inertia_kg_m2=1e-5,
        pivot_m=(0.0, pivot_y_m, height_m),
    )


def needle_height_m(depth_m: float) -> float:
    """Return the needle's height: above its face even if the panel file puts it in the face."""
    return max(depth_m, FACE_HEIGHT_M + 0.001)


def nearest_state(states: tuple[State, ...], angle_rad: float) -> str | None:
    """Return the state with the nearest place, or None if even that is too far."""
    state = min(states, key=lambda s: abs(s.angle_rad - angle_rad))
    return state.name if abs(state.angle_rad - angle_rad) <= STATE_SLACK_RAD else None
