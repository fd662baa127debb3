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
from hal.camera_model import normalised_with_jacobian
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose, skew, transform
from perception.vision.quadrangle.minima import all_minima
from perception.vision.quadrangle.posterior import MIRROR_TURN_COS, ring_mass

# Least posterior probability of other poses that is reported as ambiguity. With lights 300 x 200 mm apart, noise of
# 1 px, 2 m away at 5 to 60 degrees, 13 % of the views are flagged and 0.4 % are wrong without a flag; 0.02 would flag
# 20.5 % and miss 0.09 %.
AMBIGUOUS_SHARE = 0.11
NEAR_SIGMAS2 = 60.0  # the wall between two minima is 4 times lower than a Gaussian: chi-square 15 at the line of sight
LISTED_CHI_SQUARE = 16.0  # minima farther above the best are not listed as alternatives (odds below 1 in 3000)
WORTHLESS = 60.0  # a minimum with a chi-square so far above the best has odds of 1 in 1e13
LEAST_WIDTH = 1e-3  # of points, over their size; narrower ones are on one line
LEAST_RATIO = 1e-4  # of the masses on both sides of the line of sight, below which the other one is no alternative


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
        return transform(self.rotation, self.translation_m)


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
        return transform(self.rotation, self.translation_m)

    @property
    def poses(self) -> list[UncertainPose]:
        """The maximum-likelihood pose, then the other minima, most likely first, for the arithmetic of `hal.geometry`."""
        best = UncertainPose(parent_from_child=self.camera_from_object, covariance=self.covariance)
        return [best, *(
            UncertainPose(parent_from_child=other.camera_from_object, covariance=other.covariance)
            for other in self.alternatives if other.covariance is not None
        )]  # fmt: skip

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
    m, A = _normalised(pixels, covariance, intrinsics)
    centre = points.mean(axis=0)
    X = points - centre
    _, sizes, axes = np.linalg.svd(X)
    if not sizes[1] > LEAST_WIDTH * np.linalg.norm(sizes):
        raise NotObservable(
            "the four points lie on one line, so the turn about that line stays free",
            hint="move one light off the line",
        )
    normal = axes[2]
    Rs, ts, costs, Ns = all_minima(X, m, A, normal)
    if not len(costs):
        raise NotFound(
            "no pose puts all four points in front of the camera", hint="check the order of the lights and the camera"
        )
    best = [k for k in np.argsort(costs) if costs[k] - costs.min() <= WORTHLESS]  # not those that diverged to infinity
    Rs, ts, costs, Ns = Rs[best], ts[best], costs[best], Ns[best]
    Cs, masses = _weighed(Ns, costs)
    opposite = _mass_opposite(Rs, ts, Cs, costs, masses, (X, m, A, normal))
    if opposite is not None:
        R, t, cost, mass = opposite
        Rs, ts = np.concatenate([Rs, R[None]]), np.concatenate([ts, t[None]])
        costs, masses = np.append(costs, cost), np.append(masses, mass)
    return _answer(Rs, ts - Rs @ centre, _of_origin(Cs, Rs @ centre), costs, masses)


def _of_origin(Cs: Array, levers: Array) -> Array:
    """Return the covariances of poses for the object's own origin, at -lever in camera axes: d <- d + lever x r."""
    moves = np.tile(np.eye(6), (len(Cs), 1, 1))
    moves[:, :3, 3:] = [skew(lever) for lever in levers[: len(Cs)]]
    return np.asarray(moves @ Cs @ moves.swapaxes(1, 2))


def _answer(Rs: Array, ts: Array, Cs: Array, costs: Array, masses: Array) -> QuadranglePose:
    """Return the poses, the best one first, as the result; one without a covariance is no minimum."""
    alternatives = [
        AlternativePose(
            rotation=Rs[k], translation_m=ts[k], covariance=Cs[k] if k < len(Cs) else None, chi_square=float(costs[k]),
            odds=float(masses[k]),
        )
        for k in range(1, len(costs)) if costs[k] - costs[0] < LISTED_CHI_SQUARE
    ]  # fmt: skip
    alternatives.sort(key=lambda a: -a.odds)
    probability = 1.0 / float(masses.sum())
    return QuadranglePose(
        rotation=Rs[0], translation_m=ts[0], covariance=Cs[0], chi_square=float(costs[0]), probability=probability,
        ambiguous=probability < 1.0 - AMBIGUOUS_SHARE, alternatives=tuple(alternatives),
    )  # fmt: skip


def _weighed(Ns: Array, costs: Array) -> tuple[Array, Array]:
    """Return the covariances (M, 6, 6) and, relative to the first, the posterior masses of minima by Laplace's method.

    Args:
        Ns: (M, 6, 6) Gauss-Newton matrices.

    Raises:
        NotObservable: one of them is not positive definite.
    """
    try:
        roots = np.linalg.inv(np.linalg.cholesky(Ns))
    except np.linalg.LinAlgError:
        raise NotObservable(
            "the four points leave a direction of the pose free", hint="spread the lights further apart"
        ) from None
    log_sizes = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    return roots.swapaxes(1, 2) @ roots, np.exp(-0.5 * (costs - costs[0]) + log_sizes - log_sizes[0])


def _mass_opposite(
    Rs: Array, ts: Array, Cs: Array, costs: Array, masses: Array, problem: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, float, float] | None:
    """Weigh the poses on the other side of the line of sight by the posterior over the normal, if the best is near it.

    The masses of minima there are scaled up to that. If there is none, but mass, the result is R, t, chi-square and mass
    of its middle; else it is None.

    Args:
        problem: points, their normalised pixels, the information of these, and the normal.
    """
    normals = Rs @ problem[3]
    sight, turn = ts[0] / np.linalg.norm(ts[0]), Cs[0, 3:, 3:]
    across = skew(normals[0]) @ sight
    sine = float(np.linalg.norm(across))
    tilt_rad = np.arctan2(sine, abs(normals[0] @ sight))
    if (tilt_rad * sine) ** 2 > NEAR_SIGMAS2 * (across @ turn @ across):
        return None
    here, there, R, t, cost = ring_mass(Rs[0], ts[0], costs[0], *problem)
    # The area of the covariance of the normal, sr, which is the mass of the best pose alone.
    area = np.sqrt(max(0.0, np.linalg.det(turn) * (normals[0] @ np.linalg.solve(turn, normals[0]))))
    ratio = there / max(here, 2.0 * np.pi * area)
    cosines, along = normals @ normals[0], normals @ sight
    is_there = (cosines - along * along[0] < 1e-9) & (cosines < MIRROR_TURN_COS)
    mass = float(masses[is_there].sum())
    if mass > 0.0:
        masses[is_there] *= max(1.0, ratio / mass)
    return (R, t, cost, ratio) if not mass > 0.0 and ratio > LEAST_RATIO and np.isfinite(cost) else None


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
    is_good = (
        (covariance[:, 0, 0] > 0.0) & (np.linalg.det(covariance) > 0.0) & (covariance[:, 0, 1] == covariance[:, 1, 0])
    )
    if not is_good.all():
        raise InvalidRequest(
            f"covariance_px[{is_good.argmin()}] is not symmetric positive definite",
            hint="give a variance in px squared",
        )
    return points, pixels, covariance


def _normalised(pixels: Array, covariance: Array, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """Return ideal normalised coordinates (4, 2) and their information (4, 3), see `cost`.

    Raises:
        InvalidRequest: the lens model cannot have produced a pixel.
    """
    ideal, J = normalised_with_jacobian(pixels, intrinsics)
    is_seen = np.isfinite(ideal).all(axis=1)
    if not is_seen.all():
        raise InvalidRequest(
            f"points_px[{is_seen.argmin()}] lies where this lens model folds back", hint="check the camera calibration"
        )
    information = np.linalg.inv(J @ covariance @ J.swapaxes(1, 2))
    return ideal, np.ascontiguousarray(information[:, (0, 0, 1), (0, 1, 1)])
