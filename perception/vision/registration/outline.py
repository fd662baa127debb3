"""Edges that an object shows in every state: contour points of the panel file's objects in the panel frame."""

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
    """Samples of a contour: `points_m` (N, 3) in the panel frame, `normals` (N, 2) unit, outward on the plate.

    `reach_m`: how far inside or outside of the contour a parallel edge of the same object may be stronger.
    """

    points_m: Array
    normals: Array
    reach_m: float = 0.0


def edges_of(panel_object: PanelObject) -> Outline | None:
    """Return the edges that every state shows; None for kinds whose fixed parts the panel file does not describe."""
    rim = panel_object.rim
    if rim is None:
        return None
    x, y = panel_object.position_m
    if rim.shape == "circle":
        edges = _circle(x, y, rim.above_plate_m, rim.width_m / 2)
    else:
        size = {"width_m": rim.width_m, "height_m": rim.height_m}
        edges = rectangle(x, y, rim.above_plate_m, **size, count=SIDE_POINTS)
    return replace(edges, reach_m=rim.reach_m)


def plate_edges(panel: Panel) -> Outline:
    """Return the border of the plate's front face."""
    return rectangle(0.0, 0.0, 0.0, width_m=panel.width_m, height_m=panel.height_m, count=PLATE_POINTS)


def box_m(panel_object: PanelObject) -> Array:
    """Return the corners (4, 3) of the object's footprint, upper left first and clockwise as the viewer sees it."""
    face = panel_object.face
    w, h, z = face.half_width_m, face.half_height_m, face.height_m
    x, y = panel_object.position_m
    return np.array([[x - w, y + h, z], [x + w, y + h, z], [x + w, y - h, z], [x - w, y - h, z]])


def contour_m(panel_object: PanelObject) -> Array:
    """Return a closed contour (N, 3) for drawing: a circle for round kinds, else the footprint."""
    edges = edges_of(panel_object)
    if edges is not None:
        return edges.points_m
    if panel_object.is_round:
        return _circle(*panel_object.position_m, panel_object.face.height_m, panel_object.face.half_width_m).points_m
    return box_m(panel_object)


def rectangle(x: float, y: float, z: float, *, width_m: float, height_m: float, count: int) -> Outline:
    """Return the four sides of a rectangle with `count` points per side, without the corners."""
    s = (np.arange(count) + 0.5) / count - 0.5
    w, h, half, one, zero = s * width_m, s * height_m, 0.5, np.ones(count), np.zeros(count)
    px = np.concatenate([w, one * half * width_m, -w, -one * half * width_m])
    py = np.concatenate([one * half * height_m, -h, -one * half * height_m, h])
    normals = np.column_stack([np.concatenate([zero, one, zero, -one]), np.concatenate([one, zero, -one, zero])])
    return Outline(points_m=np.column_stack([px + x, py + y, np.full(4 * count, z)]), normals=normals)


def _circle(x: float, y: float, z: float, radius_m: float) -> Outline:
    """Return a circle about (x, y) at height z."""
    a = 2 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    normals = np.column_stack([np.sin(a), np.cos(a)])
    points = np.column_stack([x + radius_m * normals[:, 0], y + radius_m * normals[:, 1], np.full(CIRCLE_POINTS, z)])
    return Outline(points_m=points, normals=normals)
