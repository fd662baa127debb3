"""Finds faults in the layout of a panel: names given twice, parts off the plate, parts that overlap."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

from pydantic_core import InitErrorDetails

from hal.panel.angles import Location, fault
from hal.panel.base import PanelObject
from hal.panel.parts import Light, Tag, Vector2

OVERLAP_M = 0.001  # a smaller overlap of two parts is accepted, because drawings are rounded to millimetres
Part = Light | Tag | PanelObject
Parts = Mapping[Location, Part]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Foot:
    """Area that a part covers on the plate: a circle, or a rectangle rotated counter-clockwise."""

    centre_m: Vector2
    half_m: Vector2
    turn_rad: float = 0.0
    is_round: bool = False

    def across(self, x: float, y: float) -> float:
        """Return half the extent along a unit direction."""
        if self.is_round:
            return self.half_m[0]
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return self.half_m[0] * abs(c * x + s * y) + self.half_m[1] * abs(c * y - s * x)


def faults_of(width_m: float, height_m: float, parts: Parts) -> list[InitErrorDetails]:
    """Return all faults of the positions of lights and objects; `parts` are keyed by their location in the file."""
    return [*_twice(parts), *_off_the_plate(width_m, height_m, parts), *_overlapping(parts), *_without_lamp(parts)]


def _twice(parts: Parts) -> Iterator[InitErrorDetails]:
    first: dict[str, Location] = {}
    for at, part in parts.items():
        if part.name in first:
            where = ".".join(map(str, first[part.name]))
            yield fault(
                (*at, "name"), part.name, f"the name {part.name!r} is given twice, first to {where}", "rename one"
            )
        first.setdefault(part.name, at)


def _off_the_plate(width_m: float, height_m: float, parts: Parts) -> Iterator[InitErrorDetails]:
    for at, part in parts.items():
        x, y = part.position_m[:2]
        plate = f"the plate is {width_m:g} x {height_m:g} m and (0, 0) is its middle"
        half_x, half_y = _half_extent(part)
        if 2 * half_x > width_m or 2 * half_y > height_m:
            what = f"{part.name} is {2 * half_x:.3g} x {2 * half_y:.3g} m, larger than the plate"
            yield fault(at, part.position_m, what, f"{plate}: give its sizes in metres")
        elif abs(x) > width_m / 2 or abs(y) > height_m / 2:
            what = f"{part.name} at ({x}, {y}) m lies off the plate"
            yield fault((*at, "position_m"), part.position_m, what, f"{plate}: move it")
        elif (over := max(abs(x) + half_x - width_m / 2, abs(y) + half_y - height_m / 2)) > OVERLAP_M:
            what = f"{part.name} at ({x}, {y}) m reaches {1e3 * over:.0f} mm beyond the plate"
            yield fault((*at, "position_m"), part.position_m, what, f"{plate}: move it, or correct its sizes")


def _overlapping(parts: Parts) -> Iterator[InitErrorDetails]:
    feet = {at: _foot(part) for at, part in parts.items()}
    for one, other in combinations(parts, 2):
        depth = _depth_m(feet[one], feet[other])
        if depth > OVERLAP_M:
            what = f"{parts[other].name} overlaps {parts[one].name} by {1e3 * depth:.0f} mm"
            yield fault((*other, "position_m"), parts[other].position_m, what, "move one of them, or correct its sizes")


def _without_lamp(parts: Parts) -> Iterator[InitErrorDetails]:
    lamps = {part.name for part in parts.values() if isinstance(part, PanelObject) and part.can_be_lit}
    for at, part in parts.items():
        lit = getattr(part, "lights_lamp", None)
        if lit is not None and lit not in lamps:
            what = f"{part.name} lights {lit!r}, which is not a lamp of the panel"
            yield fault((*at, "lights_lamp"), lit, what, f"lamps: {', '.join(sorted(lamps)) or 'none'}")


def _half_extent(part: Part) -> Vector2:
    if isinstance(part, Light):
        return part.radius_m, part.radius_m
    foot = _foot(part)
    return foot.across(1.0, 0.0), foot.across(0.0, 1.0)


def _foot(part: Part) -> _Foot:
    if isinstance(part, Light):
        return _Foot(centre_m=part.position_m[:2], half_m=(part.radius_m, part.radius_m), is_round=True)
    if isinstance(part, Tag):
        half_m = (part.half_foot_m, part.half_foot_m)
        return _Foot(centre_m=part.position_m[:2], half_m=half_m, turn_rad=-part.angle_rad)
    half = part.half_foot_m
    is_round = part.is_round or (part.rim is not None and part.rim.shape == "circle")
    return _Foot(centre_m=part.position_m, half_m=half, turn_rad=part.envelope().turn_rad, is_round=is_round)


def _depth_m(a: _Foot, b: _Foot) -> float:
    """Return the overlap of two areas in metres by the separating-axis test; negative when they are apart."""
    dx, dy = b.centre_m[0] - a.centre_m[0], b.centre_m[1] - a.centre_m[1]
    angles = [foot.turn_rad + quarter for foot in (a, b) if not foot.is_round for quarter in (0.0, math.pi / 2)]
    if a.is_round or b.is_round:
        angles.append(math.atan2(dy, dx))
    depths = []
    for angle in angles:
        x, y = math.cos(angle), math.sin(angle)
        depths.append(a.across(x, y) + b.across(x, y) - abs(dx * x + dy * y))
    return min(depths)
