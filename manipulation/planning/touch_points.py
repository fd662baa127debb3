"""Free places of the plate where a finger may touch."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.errors import NotFound
from hal.panel import Panel, PanelObject

GRID_M = 0.005
EDGE_M = 0.025  # distance from the edge, so that the finger does not miss the plate


def touch_points(panel: Panel, count: int, *, clearance_m: float = 0.030) -> Array:
    """Choose (count, 2) panel points far from every object and light, and far from each other.

    The farthest point is added repeatedly. On a plate with instruments this gives its free corners and the gaps between
    rows, and their large spread makes the normal of the touched plane as certain as possible.

    Raises:
        NotFound: the panel has too few free places.
    """
    candidates = _candidates(panel, clearance_m)
    if len(candidates) == 0:
        raise NotFound(
            f"panel {panel.name!r} has no bare place with {1e3 * clearance_m:.0f} mm round it",
            hint="give the points to touch, or a smaller clearance",
        )
    chosen = [candidates[int(np.argmax(np.linalg.norm(candidates, axis=1)))]]
    while len(chosen) < count:
        gaps = np.min([np.linalg.norm(candidates - spot, axis=1) for spot in chosen], axis=0)
        if gaps.max() < 2 * GRID_M:
            raise NotFound(
                f"panel {panel.name!r} has only {len(chosen)} bare places, {count} are wanted",
                hint="touch fewer points",
            )
        chosen.append(candidates[int(np.argmax(gaps))])
    return np.array(chosen)


def _candidates(panel: Panel, clearance_m: float) -> Array:
    x = np.arange(-panel.width_m / 2 + EDGE_M, panel.width_m / 2 - EDGE_M + 1e-9, GRID_M)
    y = np.arange(-panel.height_m / 2 + EDGE_M, panel.height_m / 2 - EDGE_M + 1e-9, GRID_M)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(points[room_m(panel, points) >= clearance_m])


def room_m(panel: Panel, points: Array) -> Array:
    """Return (N,) the distance of points (N, 2) of the panel to the nearest object or light, m; negative inside one."""
    gaps = [np.linalg.norm(points - light.position_m[:2], axis=1) - light.radius_m for light in panel.lights]
    return np.asarray(np.min([*gaps, *(_distance_to(points, panel_object) for panel_object in panel.objects)], axis=0))


def _distance_to(points: Array, panel_object: PanelObject) -> Array:
    """Return the distance of (N, 2) panel points to the footprint of an object in any state, m; negative inside."""
    half = np.array(panel_object.half_footprint_m)
    outside = np.abs(points - np.array(panel_object.position_m)) - half
    return np.asarray(np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0))
