"""The paper's direct route (Section II-B): three lights give several poses, the fourth picks one.

It is analytic and biased towards its first three lights: 1.3 to 55 times the error of `quadrangle.estimate`, which it
seeds. Kept as a named step because the paper describes it, and because it needs no starting value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project, rays
from hal.errors import InvalidRequest, NotFound, NotObservable
from perception.vision.quadrangle.three_point import three_point

DOUBLE_ROOT_PX = 0.5  # the solver also returns real parts of complex pairs; so near to its pixels it is a double root


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DirectPose:
    """One pose of the direct route.

    Attributes:
        rotation, translation_m: (3, 3) and (3,), camera_from_object.
        fourth_error_px: distance between the fourth light and where this pose puts it.
    """

    rotation: Array
    translation_m: Array
    fourth_error_px: float


def three_light_poses(
    points_object_m: ArrayLike, points_px: ArrayLike, intrinsics: CameraIntrinsics
) -> list[tuple[Array, Array]]:
    """Every pose (rotation, translation), at most four, that puts three points exactly on their three pixels.

    Args:
        points_object_m: (3, 3), m. points_px: (3, 2) as measured.

    Raises:
        InvalidRequest: wrong shapes or not finite.
        NotObservable: the three points lie on one line.

    Source: Grunert 1841; Haralick et al., IJCV 13(3), 1994.
    """
    points, pixels = _checked(points_object_m, points_px, 3)
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= 1e-6 * spread[0]:
        raise NotObservable("the three points lie on one line", hint="take a light off the line")
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    count = three_point(points, rays(pixels, intrinsics), Rs, ts)
    found = [(Rs[k], ts[k]) for k in range(count)]
    return [(R, t) for R, t in found if _misses_px(points, pixels, (R, t), intrinsics) < DOUBLE_ROOT_PX]


def _misses_px(points: Array, pixels: Array, pose: tuple[Array, Array], intrinsics: CameraIntrinsics) -> float:
    miss = np.abs(project(points @ pose[0].T + pose[1], intrinsics) - pixels).max()
    return float(miss) if np.isfinite(miss) else np.inf


def direct_poses(points_object_m: ArrayLike, points_px: ArrayLike, intrinsics: CameraIntrinsics) -> list[DirectPose]:
    """The poses of the first three lights, the one that fits the fourth best first.

    Args:
        points_object_m: (4, 3), m, in any quadrangle whose first three points are not on one line.
        points_px: (4, 2) as measured.

    Raises:
        InvalidRequest, NotObservable: as `three_light_poses`.
        NotFound: the three rays admit no pose.
    """
    points, pixels = _checked(points_object_m, points_px, 4)
    found = []
    for R, t in three_light_poses(points[:3], pixels[:3], intrinsics):
        fourth = project((R @ points[3] + t)[None], intrinsics)[0]
        error_px = float(np.linalg.norm(fourth - pixels[3]))
        found.append(DirectPose(rotation=R, translation_m=t, fourth_error_px=error_px))
    if not found:
        raise NotFound("no pose puts the first three lights on their pixels", hint="check the order of the lights")
    return sorted(found, key=lambda pose: (not np.isfinite(pose.fourth_error_px), pose.fourth_error_px))


def _checked(points_object_m: ArrayLike, points_px: ArrayLike, count: int) -> tuple[Array, Array]:
    points, pixels = np.ascontiguousarray(points_object_m, float), np.ascontiguousarray(points_px, float)
    if points.shape != (count, 3) or pixels.shape != (count, 2):
        raise InvalidRequest(
            f"expected ({count}, 3) points and ({count}, 2) pixels, not {points.shape} and {pixels.shape}",
            hint="one row a light, in the same order",
        )
    if not (np.isfinite(points).all() and np.isfinite(pixels).all()):
        raise InvalidRequest("points or pixels are not finite", hint="leave the measurement out or repeat it")
    return points, pixels
