"""What edges every kind of object shows, whatever its state: contour points of the panel file in the panel frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hal.arrays import Array
from hal.panel import Panel, PanelObject

CIRCLE_POINTS = 32
SIDE_POINTS = 10
PLATE_POINTS = 40


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outline:
    """Contour samples: `points_m` (N, 3) in the panel frame, `normals` (N, 2) unit, outward on the plate.

    `reach_m`: how far inside or outside of the contour a parallel edge of the same object may be the stronger one.
    """

    points_m: Array
    normals: Array
    reach_m: float = 0.0


def edges_of(thing: PanelObject) -> Outline | None:
    """The edges that every state shows; None for kinds whose fixed parts the panel file leaves open."""
    x, y = thing.position_m
    match thing.kind:
        case "gauge":
            # The rim lies at the plate; only the needle stands `depth_m` above it. The face begins inside the rim.
            return replace(_circle(x, y, 0.0, thing.radius_m), reach_m=0.12 * thing.radius_m)
        case "lamp":
            return _circle(x, y, 0.0, thing.radius_m)
        case "handwheel":
            return _circle(x, y, thing.height_m - thing.rim_m, thing.radius_m + thing.rim_m)
        case "rotary":
            return _circle(x, y, thing.height_m / 2, thing.radius_m)
        case "panel_meter":
            return rectangle(x, y, 0.0, width_m=thing.width_m, height_m=thing.height_m, count=SIDE_POINTS)
        case "display":
            return rectangle(x, y, 0.0, width_m=thing.width_m, height_m=thing.height_m, count=SIDE_POINTS)
        case _:
            return None


def plate_edges(panel: Panel) -> Outline:
    """The border of the plate's front face."""
    return rectangle(0.0, 0.0, 0.0, width_m=panel.width_m, height_m=panel.height_m, count=PLATE_POINTS)


def footprint_m(thing: PanelObject) -> tuple[float, float, float]:
    """Half width, half height and the height above the plate of the box that holds the object, metres."""
    match thing.kind:
        case "gauge":
            return thing.radius_m, thing.radius_m, thing.depth_m
        case "panel_meter":
            return thing.width_m / 2, thing.height_m / 2, thing.depth_m
        case "display":
            return thing.width_m / 2, thing.height_m / 2, 0.0
        case "lamp" | "button" | "mushroom" | "rotary":
            return thing.radius_m, thing.radius_m, thing.height_m
        case "handwheel":
            outer = thing.radius_m + thing.rim_m
            return outer, outer, thing.height_m - thing.rim_m
        case "toggle":
            reach = thing.bat_length_m * np.sin(thing.tilt_rad) + thing.bat_radius_m
            half_width = max(3.0 * thing.bat_radius_m, 0.010)
            return half_width, max(reach, half_width), thing.bat_length_m * np.cos(thing.tilt_rad)
        case "slider":
            along = thing.travel_m / 2 + thing.cap_size_m[0] / 2
            across = thing.cap_size_m[1] / 2
            c, s = abs(np.cos(thing.angle_rad)), abs(np.sin(thing.angle_rad))
            return along * c + across * s, along * s + across * c, thing.cap_size_m[2]
        case "lever":
            return thing.length_m, thing.length_m, thing.height_m


def box_m(thing: PanelObject) -> Array:
    """(4, 3) corners of the object's footprint, upper left first and clockwise as the viewer sees it."""
    w, h, z = footprint_m(thing)
    x, y = thing.position_m
    return np.array([[x - w, y + h, z], [x + w, y + h, z], [x + w, y - h, z], [x - w, y - h, z]])


def contour_m(thing: PanelObject) -> Array:
    """(N, 3) closed contour for drawing: a circle for round kinds, else the footprint."""
    edges = edges_of(thing)
    if edges is not None:
        return edges.points_m
    if thing.kind in ("button", "mushroom"):
        return _circle(*thing.position_m, footprint_m(thing)[2], footprint_m(thing)[0]).points_m
    return box_m(thing)


def rectangle(x: float, y: float, z: float, *, width_m: float, height_m: float, count: int) -> Outline:
    """The four sides of a rectangle, `count` points a side, corners left out."""
    s = (np.arange(count) + 0.5) / count - 0.5
    w, h, half, one, zero = s * width_m, s * height_m, 0.5, np.ones(count), np.zeros(count)
    px = np.concatenate([w, one * half * width_m, -w, -one * half * width_m])
    py = np.concatenate([one * half * height_m, -h, -one * half * height_m, h])
    normals = np.column_stack([np.concatenate([zero, one, zero, -one]), np.concatenate([one, zero, -one, zero])])
    return Outline(points_m=np.column_stack([px + x, py + y, np.full(4 * count, z)]), normals=normals)


def _circle(x: float, y: float, z: float, radius_m: float) -> Outline:
    a = 2 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    normals = np.column_stack([np.sin(a), np.cos(a)])
    points = np.column_stack([x + radius_m * normals[:, 0], y + radius_m * normals[:, 1], np.full(CIRCLE_POINTS, z)])
    return Outline(points_m=points, normals=normals)
