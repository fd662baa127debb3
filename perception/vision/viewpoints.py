"""Camera poses for views of the panel: frontal, near enough to read, far enough to show everything.

Every function returns `base_from_camera` poses, best first; the caller takes the first that its arm can reach.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.geometry import transform
from hal.panel import Panel, PanelObject

FILL = 0.85  # share of the image that the target may fill, because pose and mount are not exact
CLOSE_UP_M = 0.30
READING_PX_PER_M = 1540.0  # finely enough to read every kind of instrument: a face of 72 mm is 110 px wide
CLOSE_UP_STRETCHES = (1.0, 1.13, 1.27)  # the arm may reach only the farther poses
SIDES = {  # rotations about the panel's x and y, in order around the object: the way across is 1.5 times as long
    "the right": (0.0, 1.0),
    "below": (1.0, 0.0),
    "the left": (0.0, -1.0),
    "above": (-1.0, 0.0),
}
SIDE_RAD = (0.42, 0.32)  # readers tolerate a tilt of 0.5; a cable 30 mm in front of a display appears shifted by 13 mm
SIDE_M = (0.34, 0.38, CLOSE_UP_M)  # farther away than a close-up, because an occluder hangs in front of the panel
NEAR_M = 0.25  # at such a tilt the fingers extend 10 cm beyond the camera
NEAR_SIDES = {"close by below": (0.45, 0.0), "close by the right": (0.0, 0.2)}  # tilts, rad
CLOSE_SIDES = (*NEAR_SIDES, "the right")  # for two states that look alike from farther away
ROLLS = (0.0, math.pi / 2, -math.pi / 2, math.pi)
TINY_M = 1e-12  # of a direction, so that a line along a face divides by no zero
REACH_M = 0.045  # half size of the area around an object that a close-up must show

Box = tuple[RigidTransform, tuple[float, float, float]]
"""Pose of its middle, and half of its edges, m."""


def facing(
    base_from_panel: RigidTransform,
    point_m: Sequence[float],
    distance_m: float,
    *,
    roll_rad: float = 0.0,
    tilt_rad: tuple[float, float] = (0.0, 0.0),
) -> RigidTransform:
    """Return `base_from_camera` that looks at a panel point along the panel's normal.

    Args:
        point_m: (3,) in the panel frame.
        roll_rad: rotation of the camera about its line of sight.
        tilt_rad: rotation of the line of sight from the normal, about the panel's x and y axes.
    """
    upright = np.diag([1.0, -1.0, -1.0])  # camera x along panel x, camera z into the panel
    stand = Rotation.from_euler("xyz", [tilt_rad[0], tilt_rad[1], 0.0])
    turn = Rotation.from_rotvec([0.0, 0.0, roll_rad])
    rotation = stand * Rotation.from_matrix(upright) * turn
    place = np.asarray(point_m, float) - distance_m * rotation.apply([0.0, 0.0, 1.0])
    return base_from_panel * transform(rotation.as_matrix(), place)


def overview_distance_m(panel: Panel, intrinsics: CameraIntrinsics, slack_m: float) -> float:
    """Return the distance at which the camera sees the whole plate, wherever the plate is within `slack_m`."""
    half_view_x = FILL * min(intrinsics.cx_px, intrinsics.width_px - intrinsics.cx_px) / intrinsics.fx_px
    half_view_y = FILL * min(intrinsics.cy_px, intrinsics.height_px - intrinsics.cy_px) / intrinsics.fy_px
    return max((panel.width_m / 2 + slack_m) / half_view_x, (panel.height_m / 2 + slack_m) / half_view_y)


def overview_poses(
    base_from_panel: RigidTransform, panel: Panel, intrinsics: CameraIntrinsics, slack_m: float
) -> Iterator[RigidTransform]:
    """Yield camera poses that see the whole panel, best first: frontal, at other distances, then from the side."""
    distance_m = overview_distance_m(panel, intrinsics, slack_m)
    for tilt_x in (0.0, 0.2, -0.2, 0.35, -0.35):
        for stretch in (1.0, 0.92, 1.1):
            for tilt_y in (0.0, 0.2, -0.2):
                yield facing(base_from_panel, (0.0, 0.0, 0.0), stretch * distance_m, tilt_rad=(tilt_x, tilt_y))


def reading_distance_m(intrinsics: CameraIntrinsics) -> float:
    """Return the largest distance at which a camera resolves the panel well enough to read it, m.

    It is never less than that of a close-up, because the fingers extend beyond the camera.
    """
    return max(CLOSE_UP_M, min(intrinsics.fx_px, intrinsics.fy_px) / READING_PX_PER_M)


def close_up_poses(
    base_from_panel: RigidTransform, point_m: Sequence[float], distance_m: float = CLOSE_UP_M
) -> Iterator[RigidTransform]:
    """Yield camera poses for reading the objects around a panel point from about a distance, best first."""
    for stretch in CLOSE_UP_STRETCHES:
        for tilt in ((0.0, 0.0), (0.12, 0.0), (-0.12, 0.0), (0.0, 0.12), (0.0, -0.12), (0.22, 0.0), (-0.22, 0.0)):
            for roll in ROLLS:
                yield facing(base_from_panel, point_m, stretch * distance_m, roll_rad=roll, tilt_rad=tilt)


def poses_from(base_from_panel: RigidTransform, point_m: Sequence[float], side: str) -> Iterator[RigidTransform]:
    """Yield camera poses from one of the `SIDES` or `NEAR_SIDES`, best first, to look at a panel point past an occluder.

    At a tilt the fingers come nearer to the occluder.
    """
    stands = [(NEAR_M, NEAR_SIDES[side])] if side in NEAR_SIDES else [
        (distance_m, (lean_rad * SIDES[side][0], lean_rad * SIDES[side][1])) for distance_m in SIDE_M for lean_rad in SIDE_RAD
    ]  # fmt: skip
    for distance_m, tilt in stands:
        for roll in ROLLS:
            yield facing(base_from_panel, point_m, distance_m, roll_rad=roll, tilt_rad=tilt)


def sides_by_sight(points_m: Array, boxes: Sequence[Box]) -> list[str]:
    """Return the `SIDES`, those from which boxes hide the least of some points first, and equal ones as listed.

    Args:
        points_m: (N, 3) in the panel frame, which is that of the boxes.
    """

    def hidden(side: str) -> float:
        tilt_rad = (SIDE_RAD[0] * SIDES[side][0], SIDE_RAD[0] * SIDES[side][1])
        view = facing(RigidTransform.identity(), points_m.mean(axis=0), SIDE_M[0], tilt_rad=tilt_rad)
        return hidden_share(view.translation, points_m, boxes)

    return sorted(SIDES, key=hidden)


def hidden_share(eye_m: Array, points_m: Array, boxes: Sequence[Box]) -> float:
    """Return the share of points (N, 3) whose lines of sight from a place (3,) cross a box; all in one frame.

    A line crosses a box where it is between the planes of each pair of faces at once (Kay and Kajiya, 1986).
    """
    is_hidden = np.zeros(len(points_m), bool)
    for parent_from_box, half_m in boxes:
        box_from_parent = parent_from_box.inv()
        eye, ways = box_from_parent.apply(eye_m), box_from_parent.apply(points_m) - box_from_parent.apply(eye_m)
        ways = np.where(np.abs(ways) < TINY_M, TINY_M, ways)
        planes = (np.array([[-1.0], [1.0]]) * np.asarray(half_m) - eye)[:, None] / ways
        enters, leaves = planes.min(axis=0).max(axis=1), planes.max(axis=0).min(axis=1)
        is_hidden |= (enters <= leaves) & (leaves > 0.0) & (enters < 1.0)
    return float(is_hidden.mean())


def close_up_groups(
    objects: Sequence[PanelObject], intrinsics: CameraIntrinsics, distance_m: float = CLOSE_UP_M
) -> list[tuple[Array, tuple[str, ...]]]:
    """Return a few close-ups that together show every object, as pairs (view centre in the panel frame, names).

    Greedy cover: each view is centred so that it shows as many of the objects as possible that no earlier view shows.
    """
    half_x = FILL * 0.5 * intrinsics.width_px / intrinsics.fx_px * distance_m - REACH_M
    half_y = FILL * 0.5 * intrinsics.height_px / intrinsics.fy_px * distance_m - REACH_M
    span = np.array([2 * half_x, 2 * half_y])
    unseen = {panel_object.name: np.array(panel_object.position_m) for panel_object in objects}
    groups: list[tuple[Array, tuple[str, ...]]] = []
    while unseen:
        best: tuple[str, ...] = ()
        for corner_x in unseen.values():
            for corner_y in unseen.values():
                low = np.array([corner_x[0], corner_y[1]])
                inside = tuple(name for name, p in unseen.items() if np.all(p >= low) and np.all(p <= low + span))
                best = max(best, inside, key=len)
        places = np.array([unseen.pop(name) for name in best])
        centre = 0.5 * (places.min(axis=0) + places.max(axis=0))
        groups.append((np.array([*centre, 0.0]), best))
    return groups
