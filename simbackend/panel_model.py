"""The panel file as bodies: a plate, what is printed on it, and one small body for each light and object.

Everything is in panel axes about the object's middle on the plate (z out of the plate). Joints count clockwise turns,
metres along the track, or metres out of the plate as positive. Heights: instrument faces lie 1 mm above the plate and
needles `depth_m` above it; a lever's bar is the uppermost 16 mm below `height_m`, from the hub to `length_m`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.panel import (
    Button,
    Display,
    Gauge,
    Handwheel,
    Lamp,
    Lever,
    Light,
    Mushroom,
    PanelMeter,
    Rotary,
    Slider,
    Toggle,
)
from simbackend import textures
from simbackend.panel_state import Built
from simbackend.urdf import Colour, along, at, box, cylinder, inertial, joint, link, shape, sphere

LENS_M = 0.0004
FACE_HEIGHT_M = 0.001
BAR_THICKNESS_M = 0.016
WHEEL_SEGMENTS = 20
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
    """A flat picture: `round` ones are discs. Centre and size in the object's axes, metres."""

    pixels: textures.Pixels
    size_m: tuple[float, float]
    centre_m: tuple[float, float, float]
    is_round: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectModel:
    """What the world loads for one object. `urdf` has the base link `base` and at most one moving joint."""

    urdf: list[str] = field(default_factory=list)
    quads: tuple[Quad, ...] = ()
    place: float = 0.0


def object_model(built: Built) -> ObjectModel:  # one a kind
    """The model of one built object."""
    match built.panel_object:
        case Gauge():
            return _gauge(built.panel_object, built)
        case PanelMeter():
            return _meter(built.panel_object, built)
        case Display():
            return _display(built.panel_object, built)
        case Lamp():
            return ObjectModel(
                urdf=_disc(
                    built.panel_object.radius_m,
                    max(built.panel_object.height_m, LENS_M),
                    PAINT[built.panel_object.colour],
                )
            )
        case Button():
            return _button(built.panel_object)
        case Mushroom():
            return _mushroom(built.panel_object)
        case Toggle():
            return _toggle(built.panel_object, built)
        case Rotary():
            return _rotary(built.panel_object, built)
        case Slider():
            return _slider(built.panel_object, built)
        case Lever():
            return _lever(built.panel_object, built)
        case Handwheel():
            return _handwheel(built.panel_object, built)


def light_urdf(light: Light) -> str:
    """A border light: a dark holder (base) with a thin lens (link 0) whose face is at the light's place.

    Were the whole body to shine, its flank would move the middle of the spot by half a pixel in a slanting view.
    """
    low_m = max(light.position_m[2] - LENS_M, 1e-4)
    lines = _base(shape(at(0, 0, low_m / 2), cylinder(light.radius_m, low_m), INK))
    lines += link(
        "lens",
        inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0)),
        shape(at(0, 0, LENS_M / 2), cylinder(light.radius_m, LENS_M), STEEL),
    )
    return robot([*lines, *joint("lens", "fixed", "base", "lens", at(0, 0, low_m))])


def robot(lines: list[str]) -> str:
    """The whole URDF text."""
    return "\n".join(['<robot name="part">', *lines, "</robot>"])


def _base(*parts: list[str]) -> list[str]:
    return link("base", inertial(0.0, (0, 0, 0), (0.0, 0.0, 0.0)), *parts)


def _disc(radius_m: float, height_m: float, colour: Colour) -> list[str]:
    return _base(shape(at(0, 0, height_m / 2), cylinder(radius_m, height_m), colour))


def _moving(
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
    lines = _base(*(fixed or []))
    lines += link("part", inertial(mass_kg, (0, 0, 0), (inertia_kg_m2,) * 3), *parts)
    return lines + joint("part", kind, "base", "part", at(*pivot_m), axis=axis, limits=limits)


def _needle(*, length_m: float, tail_m: float, width_m: float, height_m: float, pivot_y_m: float) -> list[str]:
    middle_m = (length_m - tail_m) / 2
    parts = [
        shape(at(0, middle_m, 0), box((width_m, length_m + tail_m, 0.0006)), INK, collision=False),
        shape(at(0, 0, 0), cylinder(1.8 * width_m, 0.0012), INK, collision=False),
    ]
    return _moving(
        parts,
        kind="revolute",
        axis=(0, 0, -1),
        limits=(-7.0, 7.0),
        mass_kg=0.002,
        inertia_kg_m2=1e-5,
        pivot_m=(0.0, pivot_y_m, height_m),
    )


def _needle_height_m(depth_m: float) -> float:
    """A needle hovers over its face even where the file says that it lies in it."""
    return max(depth_m, FACE_HEIGHT_M + 0.001)


def _gauge(panel_object: Gauge, built: Built) -> ObjectModel:
    r = panel_object.radius_m
    needle = _needle(
        length_m=0.76 * r,
        tail_m=0.22 * r,
        width_m=0.055 * r,
        height_m=_needle_height_m(panel_object.depth_m),
        pivot_y_m=0.0,
    )
    face = Quad(
        pixels=textures.gauge_face(panel_object), size_m=(2 * r, 2 * r), centre_m=(0, 0, FACE_HEIGHT_M), is_round=True
    )
    return ObjectModel(urdf=needle, quads=(face,), place=built.place)


def _meter(panel_object: PanelMeter, built: Built) -> ObjectModel:
    needle = _needle(
        length_m=panel_object.needle_m,
        tail_m=0.12 * panel_object.needle_m,
        width_m=0.0016,
        height_m=_needle_height_m(panel_object.depth_m),
        pivot_y_m=-panel_object.pivot_below_m,
    )
    face = Quad(
        pixels=textures.meter_face(panel_object),
        size_m=(panel_object.width_m, panel_object.height_m),
        centre_m=(0, 0, FACE_HEIGHT_M),
    )
    return ObjectModel(urdf=needle, quads=(face,), place=built.place)


def _display(panel_object: Display, built: Built) -> ObjectModel:
    pixels = textures.display_face(panel_object, built.text or "")
    return ObjectModel(
        quads=(
            Quad(pixels=pixels, size_m=(panel_object.width_m, panel_object.height_m), centre_m=(0, 0, FACE_HEIGHT_M)),
        )
    )


def _button(panel_object: Button) -> ObjectModel:
    cap = shape(
        at(0, 0, panel_object.height_m / 2),
        cylinder(panel_object.radius_m, panel_object.height_m),
        PAINT[panel_object.colour],
    )
    urdf = _moving(
        [cap], kind="prismatic", axis=(0, 0, 1), limits=(-panel_object.travel_m, 0.0), mass_kg=0.05, inertia_kg_m2=1e-4
    )
    return ObjectModel(urdf=urdf)


def _mushroom(panel_object: Mushroom) -> ObjectModel:
    head_m = 0.5 * panel_object.height_m
    parts = [
        shape(at(0, 0, panel_object.height_m - head_m / 2), cylinder(panel_object.radius_m, head_m), RED),
        shape(
            at(0, 0, panel_object.height_m / 2 - 0.002),
            cylinder(0.5 * panel_object.radius_m, panel_object.height_m - 0.004),
            RED,
        ),
    ]
    urdf = _moving(
        parts, kind="prismatic", axis=(0, 0, 1), limits=(-panel_object.travel_m, 0.0), mass_kg=0.08, inertia_kg_m2=1e-4
    )
    return ObjectModel(urdf=urdf)


def _toggle(panel_object: Toggle, built: Built) -> ObjectModel:
    pivot_m = 0.004
    reach_m = panel_object.bat_length_m
    parts = [
        shape(at(0, 0, reach_m / 2), cylinder(0.7 * panel_object.bat_radius_m, reach_m), STEEL),
        shape(at(0, 0, reach_m - panel_object.bat_radius_m), sphere(panel_object.bat_radius_m), WHITE),
    ]
    nut = shape(at(0, 0, 0.002), cylinder(1.8 * panel_object.bat_radius_m, 0.004), (0.55, 0.56, 0.58))
    urdf = _moving(
        parts,
        kind="revolute",
        axis=(-1, 0, 0),
        limits=(-panel_object.tilt_rad, panel_object.tilt_rad),
        mass_kg=0.02,
        inertia_kg_m2=1e-4,
        pivot_m=(0, 0, pivot_m),
        fixed=[nut],
    )
    return ObjectModel(urdf=urdf, place=built.place)


def _rotary(panel_object: Rotary, built: Built) -> ObjectModel:
    r, h = panel_object.radius_m, panel_object.height_m
    parts = [
        shape(at(0, 0, h / 4), cylinder(r, h / 2), KNOB),
        shape(at(0, 0, 0.75 * h), box((0.45 * r, 2 * r, h / 2)), KNOB),
        shape(at(0, 0.6 * r, h), box((0.12 * r, 0.75 * r, 0.0006)), WHITE, collision=False),
    ]
    angles = [state.angle_rad for state in panel_object.states]
    limits = (min(angles) - 0.1, max(angles) + 0.1)
    urdf = _moving(parts, kind="revolute", axis=(0, 0, -1), limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4)
    return ObjectModel(urdf=urdf, place=built.place)


def _slider(panel_object: Slider, built: Built) -> ObjectModel:
    sx, sy, sz = panel_object.cap_size_m
    lift_m = 0.0005
    turn = RigidTransform.from_rotation(Rotation.from_euler("z", panel_object.angle_rad))
    parts = [
        shape(turn * at(0, 0, sz / 2 + lift_m), box((sx, sy, sz)), KNOB),
        shape(turn * at(0, 0, sz + lift_m), box((0.0016, sy, 0.0006)), WHITE, collision=False),
    ]
    axis = (math.cos(panel_object.angle_rad), math.sin(panel_object.angle_rad), 0.0)
    limits = (-panel_object.travel_m / 2, panel_object.travel_m / 2)
    urdf = _moving(parts, kind="prismatic", axis=axis, limits=limits, mass_kg=0.05, inertia_kg_m2=1e-4)
    return ObjectModel(urdf=urdf, place=built.place)


def _lever(panel_object: Lever, built: Built) -> ObjectModel:
    w, h = panel_object.width_m, panel_object.height_m
    hub_m = 0.75 * w
    bar_m = panel_object.length_m
    parts = [
        shape(at(0, 0, h / 2), cylinder(hub_m, h), RED),
        shape(at(0, bar_m / 2, h - BAR_THICKNESS_M / 2), box((w, bar_m, BAR_THICKNESS_M)), RED),
    ]
    angles = [state.angle_rad for state in panel_object.states]
    urdf = _moving(
        parts, kind="revolute", axis=(0, 0, -1), limits=(min(angles), max(angles)), mass_kg=0.2, inertia_kg_m2=5e-4
    )
    return ObjectModel(urdf=urdf, place=built.place)


def _handwheel(panel_object: Handwheel, built: Built) -> ObjectModel:
    ring_m = panel_object.height_m - panel_object.rim_m
    blue: Colour = (0.10, 0.25, 0.55)
    angles = np.linspace(0.0, 2 * np.pi, WHEEL_SEGMENTS + 1)
    points = [(panel_object.radius_m * math.sin(a), panel_object.radius_m * math.cos(a), ring_m) for a in angles]
    parts = [shape(at(0, 0, panel_object.height_m / 2 - 0.001), cylinder(0.009, panel_object.height_m - 0.002), blue)]
    for a_m, b_m in pairwise(points):
        middle, length_m = along(a_m, b_m)
        parts.append(shape(middle, cylinder(panel_object.rim_m, length_m + 0.0015), blue))
    for i in range(panel_object.spokes):
        angle = 2 * math.pi * i / panel_object.spokes
        end = (panel_object.radius_m * math.sin(angle), panel_object.radius_m * math.cos(angle), ring_m)
        middle, length_m = along((0, 0, ring_m), end)
        # The marked spoke is white and wider than the others: it shows the angle.
        colour, radius_m = (WHITE, 0.0036) if i == 0 else (blue, 0.003)
        parts.append(shape(middle, cylinder(radius_m, length_m), colour))
    urdf = _moving(
        parts,
        kind="revolute",
        axis=(0, 0, -1),
        limits=(panel_object.minimum_rad, panel_object.maximum_rad),
        mass_kg=0.3,
        inertia_kg_m2=4e-4,
    )
    return ObjectModel(urdf=urdf, place=built.place)
