"""Pose from any number of known points with correlated pixel errors, with its mirror poses and their odds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project_with_jacobian
from hal.errors import CellError, NotFound
from hal.geometry import UncertainPose, matrix_of, perturbed, skew
from hal.least_squares import Minimum, descend
from perception.vision.quadrangle import estimate
from perception.vision.quadrangle.pose import AMBIGUOUS_SHARE, LISTED_CHI_SQUARE

SAME_RAD = 1e-3  # two minima nearer to each other than this are one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointsPose:
    """The poses that the points allow, most likely first, with the share of the posterior of all but the first."""

    poses: tuple[UncertainPose, ...]
    chi_square: float
    others_share: float

    @property
    def ambiguous(self) -> bool:
        """Whether another pose cannot be excluded."""
        return self.others_share > AMBIGUOUS_SHARE


def pose_from_points(points_m: Array, points_px: Array, covariance: Array, intrinsics: CameraIntrinsics) -> PointsPose:
    """Return all poses that N >= 4 points allow.

    Args:
        points_m, points_px: (N, 3) in the panel frame, (N, 2) in the image, not undistorted.
        covariance: (2N, 2N) of the pixels, px^2, in the order u1, v1, u2, ...

    Raises:
        NotFound: no pose has the points in front of the camera.
        NotObservable: the points are on one line.
    """
    covariance = (covariance + covariance.T) / 2.0  # symmetric to the last bit
    four = _widest_four(points_px)
    blocks = np.stack([covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in four])
    seen = estimate(points_m[four], points_px[four], blocks, intrinsics)
    starts = [seen.camera_from_object, *(a.camera_from_object for a in seen.alternatives)]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    minima = _minima(points_m, points_px, whiten, intrinsics, starts)
    best = minima[0][1]
    masses = [
        np.exp(-0.5 * (m.chi_square - best.chi_square))
        * np.sqrt(np.linalg.det(m.covariance) / np.linalg.det(best.covariance))
        for _, m in minima
    ]
    # The four outermost points alone know of mirror poses that are no minimum of their own.
    others = sum(masses[1:]) if len(minima) > 1 else (1.0 - seen.probability) * (len(points_m) == len(four))
    return PointsPose(
        poses=tuple(UncertainPose(parent_from_child=pose, covariance=m.covariance) for pose, m in minima),
        chi_square=best.chi_square,
        others_share=float(others / (1.0 + others)),
    )


def _minima(
    points_m: Array, points_px: Array, whiten: Array, intrinsics: CameraIntrinsics, starts: Sequence[RigidTransform]
) -> list[tuple[RigidTransform, Minimum]]:
    """Return the distinct minima that the starts lead to, lowest chi-square first."""

    def linearise(pose: RigidTransform) -> tuple[Array, Array]:
        turned = points_m @ matrix_of(pose).T
        pixels, by_point = project_with_jacobian(turned + pose.translation, intrinsics)
        by_pose = np.concatenate([by_point, -by_point @ np.stack([skew(p) for p in turned])], axis=2)
        residual = np.nan_to_num((pixels - points_px).ravel(), nan=1e6)
        return whiten @ residual, whiten @ np.nan_to_num(by_pose.reshape(-1, 6))

    found: list[tuple[RigidTransform, Minimum]] = []
    for start in starts:
        try:
            pose, minimum = descend(start, linearise, perturbed)
        except CellError:
            continue
        if all((pose * other.inv()).rotation.magnitude() > SAME_RAD for other, _ in found):
            found.append((pose, minimum))
    if not found:
        raise NotFound("no pose fits the points that were seen", hint="check the panel file and the lens calibration")
    found.sort(key=lambda pair: pair[1].chi_square)
    return [pair for pair in found if pair[1].chi_square - found[0][1].chi_square < LISTED_CHI_SQUARE]


def _widest_four(points_px: Array) -> list[int]:
    """Return four of the points, in order around them, that enclose the largest area."""
    if len(points_px) == 4:
        return [0, 1, 2, 3]
    hull = cv2.convexHull(points_px.astype(np.float32), returnPoints=False).ravel()
    if len(hull) < 4:
        hull = np.arange(len(points_px))
    if len(hull) > 16:
        hull = hull[np.linspace(0, len(hull) - 1, 16).astype(int)]

    def area(chosen: Iterable[int]) -> float:
        x, y = points_px[list(chosen)].T
        return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))

    return list(max(combinations([int(k) for k in hull], 4), key=area))
