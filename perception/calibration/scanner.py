"""Calibration of the range scanner's mount: its points on one flat plate, seen from several poses, must be coplanar.

It suits line scanners and range cameras, because it uses only points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, matrix_of, perturbed
from hal.least_squares import Minimum, descend

LIMIT_M = 0.003  # largest accepted standard deviation of the mount's position
LIMIT_RAD = 0.02  # the same for its orientation
OUTLIER_SIGMAS = 3.0  # points farther from the plate are on something mounted on it, or mix two surfaces
ROUNDS = 3  # fits, with outliers removed after each
LEAST_POINTS = 20  # least number of points that a scan keeps
ARM_SIGMA = (1e-4, 1e-4, 1e-4)  # repeatability of the arm: m along the plate's normal, rad about its two axes
NAMES = ("shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannerView:
    """One scan of the plate: flange pose, points (N, 3) in scanner axes (m), and their noise along the rays (m).

    The noise is one number, or one per point.
    """

    base_from_flange: RigidTransform
    points_m: Array
    sigma_m: float | Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannerCalibration:
    """Result of the calibration of the scanner's mount.

    Attributes:
        flange_from_scanner: with covariance.
        chi_square, degrees: chi-square of the fit and its degrees of freedom.
        rms_m: root mean square distance of all points from the plate.
    """

    flange_from_scanner: UncertainPose
    chi_square: float
    degrees: int
    rms_m: float


def calibrate_scanner(
    views: Sequence[ScannerView], start: RigidTransform, base_from_plate: UncertainPose
) -> ScannerCalibration:
    """Estimate the scanner's mount, and refine the plate's plane (z = 0 of the plate's frame) with it.

    Minimises sum (n_i . (A_i Y p) - d_i)^2 / sigma^2 over Y = flange_from_scanner and the plane (n, d), with the
    covariance of `base_from_plate` as prior of the plane. Every scan has its own plane n_i, d_i, which differs from (n,
    d) by the repeatability of the arm. Otherwise thousands of points per scan would make the result seem accurate to
    micrometres.

    Args:
        views: scans from several distances and tilts.
        start: nominal flange_from_scanner.
        base_from_plate: the plate, from the hand-eye calibration; its normal is z.

    Raises:
        InvalidRequest: no views, wrong shapes or not finite.
        NotObservable: a direction of the mount is not determined, or too uncertain; the message names it.
    """
    points = [_checked(k, view) for k, view in enumerate(views)]
    if not points:
        raise InvalidRequest("no scans", hint="take six or more, tilted about both axes of the plate")
    normal, R = matrix_of(base_from_plate.parent_from_child)[:, 2], matrix_of(start)
    scans = [
        _Scan(base_from_flange=view.base_from_flange, points_m=p, sigma_m=_across(view, p, R, normal))
        for view, p in zip(views, points, strict=True)
    ]
    state = (start, np.zeros(3 + 3 * len(scans)))
    for _ in range(ROUNDS):
        state, minimum = _fit(scans, state, base_from_plate)
        kept = [scan.within(OUTLIER_SIGMAS, state, k, base_from_plate) for k, scan in enumerate(scans)]
        if all(len(new.points_m) == len(old.points_m) for new, old in zip(kept, scans, strict=True)):
            break
        scans = kept
    degrees = sum(len(scan.points_m) for scan in scans) - 6
    # Residuals larger than the stated noise explains make all parameters less certain, in proportion.
    covariance = minimum.covariance[:6, :6] * max(1.0, minimum.chi_square / degrees)
    _check(covariance)
    rest_m = np.concatenate([scan.heights(state, k, base_from_plate) for k, scan in enumerate(scans)])
    return ScannerCalibration(
        flange_from_scanner=UncertainPose(parent_from_child=state[0], covariance=covariance), chi_square=minimum.chi_square,
        degrees=degrees, rms_m=float(np.sqrt(np.mean(rest_m**2))),
    )  # fmt: skip


State = tuple[RigidTransform, Array]
"""The scanner's mount, and corrections (two tilts, rad, and a shift, m) of the plate, then of each scan against it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scan:
    """A scan with the standard deviations (N,) of its points normal to the plate."""

    base_from_flange: RigidTransform
    points_m: Array
    sigma_m: Array

    def rows(self, state: State, index: int, plate: UncertainPose) -> tuple[Array, Array, Array]:
        """Return heights (N,) over the scan's own plane, and their derivatives by mount (N, 6) and plane (N, 3)."""
        pose, bends = state
        frame, origin = matrix_of(plate.parent_from_child), plate.parent_from_child.translation
        bend = bends[:3] + bends[3 + 3 * index : 6 + 3 * index]
        n = frame[:, 2] + frame[:, :2] @ bend[:2]  # of length 1 up to the square of milliradians
        Ra = matrix_of(self.base_from_flange)
        turned = self.points_m @ matrix_of(pose).T
        world = (turned + pose.translation) @ Ra.T + self.base_from_flange.translation - origin
        by_pose = np.hstack([np.tile(Ra.T @ n, (len(turned), 1)), np.cross(turned, Ra.T @ n)])
        by_bend = np.hstack([world @ frame[:, :2], -np.ones((len(turned), 1))])
        return world @ n - bend[2], by_pose, by_bend

    def heights(self, state: State, index: int, plate: UncertainPose) -> Array:
        """Return the heights (N,) of the points over the plate, m."""
        return self.rows(state, index, plate)[0]

    def within(self, sigmas: float, state: State, index: int, plate: UncertainPose) -> _Scan:
        """Return the scan without points farther than `sigmas` from the plate; unchanged if too few would remain."""
        near = np.abs(self.heights(state, index, plate)) < sigmas * self.sigma_m
        if near.sum() < LEAST_POINTS:
            return self
        return _Scan(base_from_flange=self.base_from_flange, points_m=self.points_m[near], sigma_m=self.sigma_m[near])


def _fit(scans: Sequence[_Scan], start: State, plate: UncertainPose) -> tuple[State, Minimum]:
    """Fit mount and corrections by weighted nonlinear least squares, with priors on the corrections."""
    loose = np.diag(1.0 / np.array(ARM_SIGMA)[[1, 2, 0]])
    count = 9 + 3 * len(scans)
    held = np.zeros((3 + 3 * len(scans), count))
    held[:3, 6:9], held[3:, 9:] = _plane_prior(plate), np.kron(np.eye(len(scans)), loose)

    def linearise(state: State) -> tuple[Array, Array]:
        residuals, rows = [held[:, 6:] @ state[1]], [held]
        for k, scan in enumerate(scans):
            heights, by_pose, by_bend = scan.rows(state, k, plate)
            row = np.zeros((len(heights), count))
            row[:, :6] = by_pose
            row[:, 6:9] = row[:, 9 + 3 * k : 12 + 3 * k] = by_bend
            residuals.append(heights / scan.sigma_m)
            rows.append(row / scan.sigma_m[:, None])
        return np.concatenate(residuals), np.vstack(rows)

    return descend(start, linearise, lambda s, step: (perturbed(s[0], step[:6]), s[1] + step[6:]))


def _checked(index: int, view: ScannerView) -> Array:
    """Return the points of a view as an array.

    Raises:
        InvalidRequest: they are not usable.
    """
    points = np.asarray(view.points_m, float)
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or not np.isfinite(points).all()
        or not (np.asarray(view.sigma_m) > 0).all()
    ):
        raise InvalidRequest(
            f"views[{index}]: points must be finite (N, 3) with a positive sigma, not {points.shape}",
            hint="drop the readings without an echo",
        )
    return points


def _across(view: ScannerView, points: Array, R: Array, normal: Array) -> Array:
    """Return the standard deviations (N,) normal to the plate: those along the rays times the cosine of incidence."""
    world = points @ (matrix_of(view.base_from_flange) @ R).T
    cosine = np.abs(world @ normal) / np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    return np.asarray(view.sigma_m * np.maximum(cosine, 0.1))


def _plane_prior(plate: UncertainPose) -> Array:
    """Return the square-root information (3, 3) of the plate's two tilts and shift, from its 6x6 covariance."""
    R = matrix_of(plate.parent_from_child)
    n, e1, e2 = R[:, 2], R[:, 0], R[:, 1]
    # A rotation r changes n by r x n: tilt 1 = e1 . (r x n) = r . (n x e1) = r . e2, tilt 2 = -r . e1, shift = n . t.
    J = np.zeros((3, 6))
    J[0, 3:], J[1, 3:] = e2, -e1
    J[2, :3] = n
    covariance = J @ plate.covariance @ J.T + 1e-12 * np.eye(3)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _check(covariance: Array) -> None:
    """Check that the covariance of the mount is within the limits.

    Raises:
        NotObservable: a direction is too uncertain.
    """
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
