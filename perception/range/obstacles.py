"""Finds what stands before a panel in a range image and is no part of it, such as cables, doors and tools.

Every point in front of the plate that lies in no object's envelope belongs to an obstacle. Points near to each other are
joined, and each group is enclosed by boxes that follow its shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array, Mask
from hal.errors import NotFound
from hal.panel import Panel

PLATE_M = 0.015  # what stands out less may be the plate: its pose errs, and labels stand out
ON_PLATE_M = 0.004  # by which the middle of what should be the plate may be off
LEAST_BARE = 0.3  # share of an image of the panel that shows the plate
NOISE_SIGMAS = 6.0
ABOVE_M = 0.010  # over an object's envelope and beside it; pixels at an edge lie between the object and the plate
EDGE_PIXELS = 1.5  # beside an object, as far as a pixel at its edge may err
JOIN_PIXELS = 3.5  # distance of neighbours within an obstacle
LEAST_POINTS = 4  # of an obstacle; fewer are stray pixels
CELL_M = 0.02  # a box is split unless obstacles fill half of its cells of this size
FILLED = 0.5
MOST_SPLITS = 5  # a box is halved at most so often


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Obstacle:
    """A box around a part of what stands before the panel: the pose of its middle, and half its edges, m."""

    panel_from_box: RigidTransform
    half_m: tuple[float, float, float]


def find_obstacles(points_m: Array, panel: Panel, *, pitch_m: float, sigma_m: float) -> tuple[Obstacle, ...]:
    """Find what stands before a panel.

    Args:
        points_m: (N, 3) measured points in the panel frame, without those of arm and floor.
        pitch_m: distance of neighbouring pixels on the plate.
        sigma_m: standard deviation of one distance, as the sensor states it.

    Raises:
        NotFound: the plate is not where the panel should be, so that objects would be taken for obstacles.
    """
    if not shows_plate(points_m, panel):
        raise NotFound("the range image shows no plate where the panel was located", hint="locate the panel again")
    before = points_m[points_m[:, 2] > max(PLATE_M, NOISE_SIGMAS * sigma_m)]
    before = before[~_belongs_to(panel, before, aside_m=ABOVE_M + EDGE_PIXELS * pitch_m)]
    return tuple(box for group in _groups(before, JOIN_PIXELS * pitch_m) for box in _boxes(group, pitch_m, MOST_SPLITS))


def shows_plate(points_m: Array, panel: Panel) -> bool:
    """Return whether most of what is measured (N, 3 in the panel frame) before the plate's area lies on the plate."""
    half = np.array([panel.width_m, panel.height_m]) / 2
    over = points_m[(abs(points_m[:, :2]) < half).all(axis=1), 2]
    bare = over[over < PLATE_M]
    return len(bare) > LEAST_BARE * len(over) and abs(float(np.median(bare))) < ON_PLATE_M


def _belongs_to(panel: Panel, points_m: Array, *, aside_m: float) -> Mask:
    """Return which points (N, 3) of the panel frame lie in the envelope of an object in any state."""
    belongs = np.zeros(len(points_m), bool)
    for one in panel.objects:
        room = one.envelope()
        turn = Rotation.from_rotvec([0.0, 0.0, room.turn_rad])
        x, y, z = (turn.inv().apply(points_m - one.point_m) - [*room.middle_m, 0.0]).T
        half_x, half_y = room.half_m
        belongs |= (abs(x) < half_x + aside_m) & (abs(y) < half_y + aside_m) & (z < room.height_m + ABOVE_M)
    return belongs


def _groups(points_m: Array, join_m: float) -> Iterator[Array]:
    """Yield the groups of points (N, 3) that hang together."""
    if len(points_m) == 0:
        return
    near = cKDTree(points_m).sparse_distance_matrix(cKDTree(points_m), join_m, output_type="coo_matrix")
    count, labels = connected_components(near, directed=False)
    for label in range(count):
        group = points_m[labels == label]
        if len(group) >= LEAST_POINTS:
            yield group


def _boxes(points_m: Array, pitch_m: float, splits: int) -> Iterator[Obstacle]:
    """Yield boxes along the principal axes of the points (N, 3), halved until they are filled."""
    middle = points_m.mean(axis=0)
    axes = np.linalg.svd(points_m - middle, full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    along = (points_m - middle) @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    cells = np.floor((along[:, :2] - low[:2]) / CELL_M).astype(int)
    room = np.prod(np.floor((high[:2] - low[:2]) / CELL_M).astype(int) + 1)
    if splits == 0 or len(points_m) < 2 * LEAST_POINTS or len(np.unique(cells, axis=0)) >= FILLED * room:
        half = (high - low + pitch_m) / 2
        yield Obstacle(
            panel_from_box=RigidTransform.from_components(
                middle + axes.T @ ((low + high) / 2), Rotation.from_matrix(axes.T)
            ),
            half_m=(float(half[0]), float(half[1]), float(half[2])),
        )
        return
    is_first = along[:, 0] < (low[0] + high[0]) / 2
    for part in (points_m[is_first], points_m[~is_first]):
        if len(part) >= 3:
            yield from _boxes(part, pitch_m, splits - 1)
