"""Where the range scanner sits in the hand: its points on one flat plate, from several poses, must lie in one plane.

Works for a scanner that sweeps a line and for one that gives an image: only points are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, matrix_of, perturbed
from perception.calibration.newton import descend

Array = NDArray[np.float64]

LIMIT_M = 0.003
LIMIT_RAD = 0.02
ARM_SIGMA = (1e-4, 1e-4, 1e-4)  # m along the plate's normal, rad about its two axes: what the arm repeats to
NAMES = ("shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannerView:
    """One scan of the plate: the flange pose, points (N, 3) in scanner axes (m), noise of a point along its ray (m)."""

    base_from_flange: RigidTransform
    points_m: Array
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannerCalibration:
    """`flange_from_scanner` with covariance, chi-square and degrees of freedom, residual rms over all points (m)."""

    flange_from_scanner: UncertainPose
    plane_base: tuple[Array, float]
    chi_square: float
    degrees: int
    rms_m: float


def calibrate_scanner(
    views: Sequence[ScannerView], start: RigidTransform, base_from_plate: UncertainPose
) -> ScannerCalibration:
    """The scanner's mount, and the plate's plane (its z axis, through its origin) refined along with it.

    Minimises sum (n_i . (A_i Y p) - d_i)^2 / sigma^2 over Y = flange_from_scanner and the plane (n, d), the plane held
    by the covariance of `base_from_plate`. Every scan meets the plane a little off, n_i and d_i, within what the arm
    repeats to: thousands of points a scan would otherwise promise micrometres.

    Args:
        views: scans from several distances and tilts.
        start: nominal flange_from_scanner.
        base_from_plate: the plate, from the hand-eye calibration; its normal is z.

    Raises:
        InvalidRequest: no views, wrong shapes or not finite.
        NotObservable: the poses leave a direction of the mount free or too uncertain; the message names it.
    """
    points = [_checked(k, view) for k, view in enumerate(views)]
    if not points:
        raise InvalidRequest("no scans", hint="take six or more, tilted about both axes of the plate")
    frame = matrix_of(base_from_plate.parent_from_child)
    n0, across = frame[:, 2], frame[:, :2]
    origin = base_from_plate.parent_from_child.translation
    prior = _plane_prior(base_from_plate)
    loose = np.diag(1.0 / np.array(ARM_SIGMA)[[1, 2, 0]])  # bends are two tilts, then a shift
    sigmas = [_across(view, p, matrix_of(start), n0) for view, p in zip(views, points, strict=True)]
    count = 9 + 3 * len(views)

    def linearise(state: tuple[RigidTransform, Array]) -> tuple[Array, Array]:
        pose, bends = state
        Ry = matrix_of(pose)
        held = np.zeros((3 + 3 * len(views), count))
        held[:3, 6:9], held[3:, 9:] = prior, np.kron(np.eye(len(views)), loose)
        residuals, rows = [held[:, 6:] @ bends], [held]
        for k, (view, p, sigma) in enumerate(zip(views, points, sigmas, strict=True)):
            bend = bends[:3] + bends[3 + 3 * k : 6 + 3 * k]
            n = n0 + across @ bend[:2]  # its length grows by the square of milliradians
            Ra = matrix_of(view.base_from_flange)
            turned = p @ Ry.T
            world = (turned + pose.translation) @ Ra.T + view.base_from_flange.translation - origin
            nf = Ra.T @ n
            by_bend = np.hstack([world @ across, -np.ones((len(p), 1))]) / sigma[:, None]
            row = np.zeros((len(p), count))
            row[:, :6] = np.hstack([np.tile(nf, (len(p), 1)), np.cross(turned, nf)]) / sigma[:, None]
            row[:, 6:9] = row[:, 9 + 3 * k : 12 + 3 * k] = by_bend
            residuals.append((world @ n - bend[2]) / sigma)
            rows.append(row)
        return np.concatenate(residuals), np.vstack(rows)

    (pose, bends), minimum = descend(
        (start, np.zeros(count - 6)), linearise, lambda s, step: (perturbed(s[0], step[:6]), s[1] + step[6:])
    )
    normal = n0 + across @ bends[:2]
    plane = (normal / np.linalg.norm(normal), float((normal @ origin + bends[2]) / np.linalg.norm(normal)))
    degrees = sum(len(p) for p in points) - 6
    # More scatter than was stated: then everything is as much less certain.
    covariance = minimum.covariance[:6, :6] * max(1.0, minimum.chi_square / degrees)
    _check(covariance)
    rest_m = linearise((pose, bends))[0][3 + 3 * len(views) :] * np.concatenate(sigmas)
    return ScannerCalibration(
        flange_from_scanner=UncertainPose(parent_from_child=pose, covariance=covariance), plane_base=plane,
        chi_square=minimum.chi_square, degrees=degrees, rms_m=float(np.sqrt(np.mean(rest_m**2))),
    )  # fmt: skip


def _checked(index: int, view: ScannerView) -> Array:
    points = np.asarray(view.points_m, float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all() or view.sigma_m <= 0:
        raise InvalidRequest(
            f"views[{index}]: points must be finite (N, 3) with a positive sigma, not {points.shape}",
            hint="drop the readings without an echo",
        )
    return points


def _across(view: ScannerView, points: Array, R: Array, normal: Array) -> Array:
    """(N,) noise of the points across the plate: along the ray it is sigma, across it sigma times the cosine."""
    world = points @ (matrix_of(view.base_from_flange) @ R).T
    cosine = np.abs(world @ normal) / np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    return np.asarray(view.sigma_m * np.maximum(cosine, 0.1))


def _plane_prior(plate: UncertainPose) -> Array:
    """Square root information of (bend 1, bend 2, shift at its origin), from the plate's 6x6 covariance."""
    R = matrix_of(plate.parent_from_child)
    n, e1, e2 = R[:, 2], R[:, 0], R[:, 1]
    # A turn r moves n by r x n: bend1 = e1 . (r x n) = r . (n x e1) = r . e2, bend2 = -r . e1; the shift is n . t.
    J = np.zeros((3, 6))
    J[0, 3:], J[1, 3:] = e2, -e1
    J[2, :3] = n
    covariance = J @ plate.covariance @ J.T + 1e-12 * np.eye(3)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _check(covariance: Array) -> None:
    sigma = np.sqrt(np.diag(covariance))
    limits = np.array([LIMIT_M] * 3 + [LIMIT_RAD] * 3)
    worst = int(np.argmax(sigma / limits))
    if sigma[worst] > limits[worst]:
        unit = "mm" if worst < 3 else "mrad"
        raise NotObservable(
            f"the scans leave the scanner's {NAMES[worst]} (flange axes) uncertain by {1e3 * sigma[worst]:.1f} {unit}",
            hint="add scans tilted by 20 degrees or more about both axes of the plate, and turned about its normal",
            parameter=NAMES[worst],
        )
