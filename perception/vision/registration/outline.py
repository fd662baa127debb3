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


def edges_of(panel_object: PanelObject) -> Outline | None:
    """The edges that every state shows; None for kinds whose fixed parts the panel file leaves open."""
    x, y = panel_object.position_m
    match panel_object.kind:
        case "gauge":
            # The rim lies at the plate; only the needle stands `depth_m` above it. The face begins inside the rim.
            return replace(_circle(x, y, 0.0, panel_object.radius_m), reach_m=0.12 * panel_object.radius_m)
        case "lamp":
            return _circle(x, y, 0.0, panel_object.radius_m)
        case "handwheel":
            return _circle(x, y, panel_object.height_m - panel_object.rim_m, panel_object.radius_m + panel_object.rim_m)
        case "rotary":
            return _circle(x, y, panel_object.height_m / 2, panel_object.radius_m)
        case "panel_meter":
            return rectangle(x, y, 0.0, width_m=panel_object.width_m, height_m=panel_object.height_m, count=SIDE_POINTS)
        case "display":
            return rectangle(x, y, 0.0, width_m=panel_object.width_m, height_m=panel_object.height_m, count=SIDE_POINTS)
        case _:
            return None


def plate_edges(panel: Panel) -> Outline:
    """The border of the plate's front face."""
    return rectangle(0.0, 0.0, 0.0, width_m=panel.width_m, height_m=panel.height_m, count=PLATE_POINTS)


def footprint_m(panel_object: PanelObject) -> tuple[float, float, float]:
    """Half width, half height and the height above the plate of the box that holds the object, metres."""
    match panel_object.kind:
        case "gauge":
            return panel_object.radius_m, panel_object.radius_m, panel_object.depth_m
        case "panel_meter":
            return panel_object.width_m / 2, panel_object.height_m / 2, panel_object.depth_m
        case "display":
            return panel_object.width_m / 2, panel_object.height_m / 2, 0.0
        case "lamp" | "button" | "mushroom" | "rotary":
            return panel_object.radius_m, panel_object.radius_m, panel_object.height_m
        case "handwheel":
            outer = panel_object.radius_m + panel_object.rim_m
            return outer, outer, panel_object.height_m - panel_object.rim_m
        case "toggle":
            reach = panel_object.bat_length_m * np.sin(panel_object.tilt_rad) + panel_object.bat_radius_m
            half_width = max(3.0 * panel_object.bat_radius_m, 0.010)
            return half_width, max(reach, half_width), panel_object.bat_length_m * np.cos(panel_object.tilt_rad)
        case "slider":
            along = panel_object.travel_m / 2 + panel_object.cap_size_m[0] / 2
            across = panel_object.cap_size_m[1] / 2
            c, s = abs(np.cos(panel_object.angle_rad)), abs(np.sin(panel_object.angle_rad))
            return along * c + across * s, along * s + across * c, panel_object.cap_size_m[2]
        case "lever":
            return panel_object.length_m, panel_object.length_m, panel_object.height_m


def box_m(panel_object: PanelObject) -> Array:
    """(4, 3) corners of the object's footprint, upper left first and clockwise as the viewer sees it."""
    w, h, z = footprint_m(panel_object)
    x, y = panel_object.position_m
    return np.array([[x - w, y + h, z], [x + w, y + h, z], [x + w, y - h, z], [x - w, y - h, z]])


def contour_m(panel_object: PanelObject) -> Array:
    """(N, 3) closed contour for drawing: a circle for round kinds, else the footprint."""
    edges = edges_of(panel_object)
    if edges is not None:
        return edges.points_m
    if panel_object.kind in ("button", "mushroom"):
        return _circle(*panel_object.position_m, footprint_m(panel_object)[2], footprint_m(panel_object)[0]).points_m
    return box_m(panel_object)


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
