"""Pose of four lights in one image, with covariance, all alternative poses, and an ambiguity flag.

The pose minimises the reprojection error (maximum likelihood), starting from three-point and mirrored poses (paper,
Section II-B, refined).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose
from perception.vision.quadrangle.search import solve

# Least posterior probability of other poses that is reported as ambiguity. With lights 300 x 200 mm apart, noise of
# 1 px, 2 m away at 5 to 60 degrees, 13 % of the views are flagged and 0.4 % are wrong without a flag; 0.02 would flag
# 20.5 % and miss 0.09 %.
AMBIGUOUS_SHARE = 0.11
NEAR_SIGMAS2 = 60.0  # the wall between two minima is 4 times lower than a Gaussian: chi-square 15 at the line of sight
LISTED_CHI_SQUARE = 16.0  # minima farther above the best are not listed as alternatives (odds below 1 in 3000)
MOST_POSES = 7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlternativePose:
    """Another pose that the same image allows.

    Attributes:
        rotation, translation_m: (3, 3) and (3,) of the pose; `camera_from_object` returns it as a `RigidTransform`.
        covariance: 6x6 as in `QuadranglePose`. None if the pose is not a minimum: it is then the middle of the
        posterior on
            the other side of the line of sight, which the minimum of the answer reaches.
        chi_square: of its fit, 2 degrees of freedom.
        odds: its posterior mass relative to that of the answer (1 = equally likely).
    """

    rotation: Array
    translation_m: Array
    covariance: Array | None
    chi_square: float
    odds: float

    @property
    def camera_from_object(self) -> RigidTransform:
        """The pose as a `RigidTransform`."""
        return _pose(self.rotation, self.translation_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QuadranglePose:
    """Pose of an object with four known points in the camera's frame.

    Attributes:
        rotation, translation_m: (3, 3) and (3,) of the maximum-likelihood pose. `camera_from_object` returns it as a
            `RigidTransform`; it is made on request only, because that takes as long as the estimate.
        covariance: 6x6 over (dx, dy, dz, rx, ry, rz), m and rad, in camera axes: the true pose has t + d and Exp(r) R.
            It is the Cramer-Rao bound at the pose; near fronto-parallel errors are larger, see `ambiguous`.
        chi_square: weighted squared reprojection error, 2 degrees of freedom.
        probability: posterior probability that the true pose is near this one and not near one of `alternatives`.
        ambiguous: another pose cannot be excluded (`probability` below 0.89); one more view or touch decides.
        alternatives: the other poses, most likely first.
    """

    rotation: Array
    translation_m: Array
    covariance: Array
    chi_square: float
    probability: float
    ambiguous: bool
    alternatives: tuple[AlternativePose, ...]

    @property
    def camera_from_object(self) -> RigidTransform:
        """The maximum-likelihood pose as a `RigidTransform`."""
        return _pose(self.rotation, self.translation_m)

    @property
    def uncertain(self) -> UncertainPose:
        """The maximum-likelihood pose with its covariance, for the arithmetic of `hal.geometry`."""
        return UncertainPose(parent_from_child=self.camera_from_object, covariance=self.covariance)

    @property
    def p_value(self) -> float:
        """Probability of a worse fit if model and noise are right; 0.001 indicates a wrong lamp, model or lens."""
        return math.exp(-0.5 * self.chi_square)  # chi-square of 2 degrees of freedom


def estimate(
    points_object_m: ArrayLike, points_px: ArrayLike, covariance_px: ArrayLike, intrinsics: CameraIntrinsics
) -> QuadranglePose:
    """Estimate the pose of four points from their pixels, with all alternatives that the data allow.

    Minimises sum e_i^T S_i^-1 e_i over SE(3), e_i the reprojection error; every local minimum is found and weighted by
    exp(-chi2 / 2) sqrt(det covariance). Near fronto-parallel, where the mirror pose need not be a minimum, the
    posterior over the object's normal is summed instead.

    Args:
        points_object_m: (4, 3) in the object's frame, m; any quadrangle, coplanar or not.
        points_px: (4, 2) as measured (with lens distortion), in the same order.
        covariance_px: variance of each coordinate (px^2), or one (2, 2), or (4, 2, 2).
        intrinsics: the camera.

    Raises:
        InvalidRequest: wrong shapes, not finite, covariance not positive definite, or a pixel outside this lens.
        NotObservable: the four points lie on one line or in one place.
        NotFound: no pose puts the four points in front of the camera.

    Source: Section II-B of the paper; Oberkampf, DeMenthon, Davis, CVIU 63(3), 1996 for the two planar minima.
    """
    points, pixels, covariance = _checked(points_object_m, points_px, covariance_px)
    Rs, ts, costs = np.empty((MOST_POSES, 3, 3)), np.empty((MOST_POSES, 3)), np.empty(MOST_POSES)
    Cs, masses = np.empty((MOST_POSES, 6, 6)), np.empty(MOST_POSES)
    count, minima, code = solve(
        points, pixels, covariance, _camera(intrinsics), NEAR_SIGMAS2, Rs, ts, costs, Cs, masses
    )
    if code:
        _refuse(code, count)
    listed = [k for k in range(1, count) if costs[k] - costs[0] < LISTED_CHI_SQUARE]
    alternatives = [
        AlternativePose(
            rotation=Rs[k],
            translation_m=ts[k],
            covariance=Cs[k] if k < minima else None,
            chi_square=float(costs[k]),
            odds=float(masses[k]),
        )
        for k in listed
    ]
    alternatives.sort(key=lambda a: -a.odds)
    probability = 1.0 / (1.0 + float(masses[1:count].sum()))
    return QuadranglePose(
        rotation=Rs[0],
        translation_m=ts[0],
        covariance=Cs[0],
        chi_square=float(costs[0]),
        probability=probability,
        ambiguous=probability < 1.0 - AMBIGUOUS_SHARE,
        alternatives=tuple(alternatives),
    )


def warm_up() -> None:
    """Compile the kernels of `estimate`, or load them from the cache, so that its first call is fast."""
    camera = CameraIntrinsics(width_px=640, height_px=480, fx_px=500.0, fy_px=500.0, cx_px=320.0, cy_px=240.0)
    square = [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]
    estimate(square, [[270.0, 190.0], [370.0, 190.0], [370.0, 290.0], [270.0, 290.0]], 0.01, camera)


def _checked(points_object_m: ArrayLike, points_px: ArrayLike, covariance_px: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the arguments of `estimate` as arrays; the covariance becomes (4, 2, 2).

    Raises:
        InvalidRequest: they are not usable.
    """
    points = np.require(points_object_m, float, ("C", "W"))  # the layout that compiled loops require
    pixels = np.require(points_px, float, ("C", "W"))
    covariance = np.asarray(covariance_px, float)
    if points.shape != (4, 3) or pixels.shape != (4, 2):
        raise InvalidRequest(
            f"four points are needed: object (4, 3) and image (4, 2), not {points.shape} and {pixels.shape}",
            hint="give the four lights in the same order in both lists",
        )
    if covariance.ndim == 0:
        covariance = covariance * np.eye(2)
    if covariance.shape not in ((2, 2), (4, 2, 2)):
        raise InvalidRequest(
            f"covariance_px must be a variance, (2, 2) or (4, 2, 2), not {covariance.shape}", hint="in px squared"
        )
    covariance = np.array(np.broadcast_to(covariance, (4, 2, 2)), order="C")
    for name, array in (("points_object_m", points), ("points_px", pixels), ("covariance_px", covariance)):
        if not np.isfinite(array).all():
            index = int(np.argwhere(~np.isfinite(array))[0][0])
            raise InvalidRequest(f"{name}[{index}] is not finite", hint="leave the measurement out or repeat it")
    return points, pixels, covariance


def _camera(intrinsics: CameraIntrinsics) -> Array:
    """Return fx, fy, cx, cy and the distortion (9,), as `prepare` reads them."""
    return np.array([
        intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *intrinsics.distortion
    ])  # fmt: skip


def _refuse(code: int, index: int) -> None:
    """Raise the error that belongs to an error code of `solve`; `index` is its first result."""
    if code == 1 and index >= 4:
        raise InvalidRequest(
            f"covariance_px[{index - 4}] is not symmetric positive definite", hint="give a variance in px squared"
        )
    if code == 1:
        raise InvalidRequest(
            f"points_px[{index}] lies where this lens model folds back", hint="check the camera calibration"
        )
    if code == 2:
        raise NotObservable(
            "the four points lie on one line, so the turn about that line stays free",
            hint="move one light off the line",
        )
    if code == 3:
        raise NotFound(
            "no pose puts all four points in front of the camera", hint="check the order of the lights and the camera"
        )
    raise NotObservable("the four points leave a direction of the pose free", hint="spread the lights further apart")


def _pose(R: Array, t: Array) -> RigidTransform:
    """Return a rotation and a translation as a transform."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    return RigidTransform.from_matrix(matrix)
