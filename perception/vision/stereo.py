"""Points and lines in space from two or more views of the wrist camera, with covariance: sensing classes 1 and 5.

The same object seen from two wrist poses measures an untaught panel (the authors' first wish for the future).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import normalised_with_jacobian
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose, matrix_of, skew

LEAST_PARALLAX_RAD = 0.005  # at 0.5 m: a base of 2.5 mm
DISAGREEMENT_CHI_SQUARE = 30.0  # for one or two surplus measurements: chance below 1e-6
STEPS = 15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Station:
    """A camera at a known, uncertain place: base_from_camera and its intrinsics."""

    base_from_camera: UncertainPose
    intrinsics: CameraIntrinsics


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenPoint:
    """A point's pixel (2,) at a station, with covariance (2, 2) px^2."""

    station: Station
    pixel_px: Array
    covariance_px: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenLine:
    """Two pixels (2, 2) on a straight edge at a station, each with covariance (2, 2) px^2; they need not correspond."""

    station: Station
    pixels_px: Array
    covariance_px: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoPoint:
    """A point in the base frame, m, its 3x3 covariance, and how well the views agree (2 N - 3 degrees of freedom)."""

    point_m: Array
    covariance: Array
    chi_square: float
    degrees: int
    parallax_rad: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoLine:
    """A line in the base frame.

    Attributes:
        point_m: its point nearest to the middle of the cameras; direction: unit, sign arbitrary.
        covariance: 6x6 over shift of the point (across the line) and change of the direction (across it too), m and 1;
            rank 4.
        chi_square, degrees: agreement of the views (2 N - 4).
    """

    point_m: Array
    direction: Array
    covariance: Array
    chi_square: float
    degrees: int

    def direction_information(self) -> Array:
        """(3, 3) matrix M of the fusion's line measurements: v^T M v for a unit direction v."""
        values, vectors = np.linalg.eigh(self.covariance[3:, 3:])
        return np.asarray((vectors[:, 1:] / values[1:]) @ vectors[:, 1:].T)


def stereo_point(seen: Sequence[SeenPoint]) -> StereoPoint:
    """The point that all views see, by maximum likelihood over pixels and camera places.

    Minimises sum e_i^T S_i^-1 e_i over the point; S_i holds the pixel's covariance and the station's pose.

    Args:
        seen: two views or more.

    Raises:
        InvalidRequest: fewer than two views, or a pixel that is not finite or outside the lens.
        NotObservable: the rays are nearly parallel, so the depth stays free.
        NotFound: the rays do not meet: different things were seen.
    """
    if len(seen) < 2:
        raise InvalidRequest("one view", hint="look from a second wrist pose")
    ideal = [_ideal(k, s.station, np.atleast_2d(s.pixel_px)) for k, s in enumerate(seen)]
    rays = np.array([_ray(s.station, m[0]) for s, (m, _) in zip(seen, ideal, strict=True)])
    centres = np.array([s.station.base_from_camera.parent_from_child.translation for s in seen])
    parallax = _parallax(rays)
    if parallax < LEAST_PARALLAX_RAD:
        raise NotObservable(
            f"the rays differ by only {1e3 * parallax:.1f} mrad, so the depth stays free",
            hint="move the wrist sideways by a tenth of the distance or more", parallax_rad=round(parallax, 5),
        )  # fmt: skip
    # Nearest point to all rays: sum (I - r r^T)(p - c) = 0.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    for _ in range(STEPS):
        information, gradient, chi_square = np.zeros((3, 3)), np.zeros(3), 0.0
        for s, (m, J) in zip(seen, ideal, strict=True):
            e, by_point, by_pose = _reprojection(s.station, point, m[0])
            noise = J[0] @ s.covariance_px @ J[0].T + by_pose @ s.station.base_from_camera.covariance @ by_pose.T
            weight = np.linalg.inv(noise)
            information += by_point.T @ weight @ by_point
            gradient += by_point.T @ weight @ e
            chi_square += float(e @ weight @ e)
        step = -np.linalg.solve(information, gradient)
        point = point + step
        if float(step @ information @ step) < 1e-12:
            break
    degrees = 2 * len(seen) - 3
    _check_agreement(chi_square, degrees, "point")
    return StereoPoint(
        point_m=point, covariance=np.asarray(np.linalg.inv(information)), chi_square=chi_square, degrees=degrees,
        parallax_rad=parallax,
    )  # fmt: skip


def stereo_line(seen: Sequence[SeenLine]) -> StereoLine:
    """The line that all views see: each view gives a plane through its camera, and the planes share the line.

    Args:
        seen: two views or more of one straight edge.

    Raises:
        InvalidRequest: fewer than two views, or pixels not finite or outside the lens.
        NotObservable: the planes nearly coincide (the wrist moved along the edge, or not at all).
        NotFound: three views or more do not share a line.
    """
    if len(seen) < 2:
        raise InvalidRequest("one view", hint="look from a second wrist pose")
    ideal = [_ideal(k, s.station, s.pixels_px) for k, s in enumerate(seen)]
    normals = np.array([_plane(s.station, m) for s, (m, _) in zip(seen, ideal, strict=True)])
    centres = np.array([s.station.base_from_camera.parent_from_child.translation for s in seen])
    _, sigma, vt = np.linalg.svd(normals)
    if sigma[1] < LEAST_PARALLAX_RAD * sigma[0]:
        raise NotObservable(
            "the views see the edge in one and the same plane", hint="move the wrist across the edge, not along it"
        )
    direction = vt[2]
    middle = centres.mean(axis=0)
    # Nearest to the middle on every plane: n . p = n . c, and along the line it stays at the middle.
    rows = np.vstack([normals, direction])
    values = np.concatenate([np.einsum("ni,ni->n", normals, centres), [direction @ middle]])
    point = np.linalg.lstsq(rows, values, rcond=None)[0]
    for _ in range(STEPS):
        basis = np.linalg.svd(direction[None])[2][1:]  # two axes across the line
        information, gradient, chi_square = np.zeros((4, 4)), np.zeros(4), 0.0
        for s, (m, J) in zip(seen, ideal, strict=True):
            e, by_line, noise = _line_residual(s, m, J, (point, direction, basis))
            weight = np.linalg.inv(noise)
            information += by_line.T @ weight @ by_line
            gradient += by_line.T @ weight @ e
            chi_square += float(e @ weight @ e)
        step = -np.linalg.solve(information, gradient)
        point = point + step[:2] @ basis
        direction = direction + step[2:] @ basis
        direction = direction / np.linalg.norm(direction)
        if float(step @ information @ step) < 1e-12:
            break
    degrees = 2 * len(seen) - 4
    _check_agreement(chi_square, max(degrees, 1), "line")
    lift = np.zeros((6, 4))
    lift[:3, :2] = lift[3:, 2:] = basis.T
    covariance = lift @ np.linalg.inv(information) @ lift.T
    return StereoLine(point_m=point, direction=direction, covariance=covariance, chi_square=chi_square, degrees=degrees)


def _ideal(index: int, station: Station, pixels_px: Array) -> tuple[Array, Array]:
    pixels = np.asarray(pixels_px, float)
    ideal, jacobian = normalised_with_jacobian(pixels, station.intrinsics)
    if not np.isfinite(ideal).all():
        raise InvalidRequest(
            f"seen[{index}] holds a pixel that is not finite or outside the lens", hint="check pixel and calibration"
        )
    return ideal, jacobian


def _ray(station: Station, m: Array) -> Array:
    ray = matrix_of(station.base_from_camera.parent_from_child) @ [m[0], m[1], 1.0]
    return np.asarray(ray / np.linalg.norm(ray))


def _plane(station: Station, m: Array) -> Array:
    """Unit normal, base axes, of the plane through the camera and two ideal image points."""
    normal = np.cross(_ray(station, m[0]), _ray(station, m[1]))
    size = float(np.linalg.norm(normal))
    if size < 1e-9:
        raise InvalidRequest("both pixels of a line are the same", hint="give two pixels apart on the edge")
    return np.asarray(normal / size)


def _parallax(rays: Array) -> float:
    """Largest angle between two rays."""
    sines = np.linalg.norm(np.cross(rays[:, None, :], rays[None, :, :]), axis=2)
    return float(np.arcsin(np.clip(sines, 0.0, 1.0)).max())


def _reprojection(station: Station, point: Array, m: Array) -> tuple[Array, Array, Array]:
    """Error in ideal coordinates, and its derivatives by the point (2, 3) and by the station's pose (2, 6)."""
    pose = station.base_from_camera.parent_from_child
    R = matrix_of(pose)
    q = R.T @ (point - pose.translation)
    if q[2] <= 0.0:
        raise NotFound("the rays meet behind a camera", hint="check that both views show the same thing")
    by_camera = np.array([[1.0, 0.0, -q[0] / q[2]], [0.0, 1.0, -q[1] / q[2]]]) / q[2]
    by_point = by_camera @ R.T
    # t <- t + d moves q by -R^T d; R <- Exp(r) R by R^T (y x r) with y = point - t.
    by_pose = by_camera @ R.T @ np.hstack([-np.eye(3), skew(point - pose.translation)])
    return q[:2] / q[2] - m, by_point, by_pose


def _line_residual(seen: SeenLine, m: Array, J: Array, line: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """How far the two image points are from the projected line (2,), its derivative (2, 4), and its noise (2, 2).

    With N = p x v in camera axes (the plane's normal), the error of ray x is N . x / |N_xy|.
    """
    point, direction, basis = line
    pose = seen.station.base_from_camera.parent_from_child
    R = matrix_of(pose)
    y = point - pose.translation
    N_base = np.cross(y, direction)
    N = R.T @ N_base
    scale = float(np.hypot(N[0], N[1]))
    rays = np.column_stack([m, np.ones(2)])
    e = rays @ N / scale
    by_N = (rays - np.outer(e, [N[0] / scale, N[1] / scale, 0.0])) / scale @ R.T
    by_line = by_N @ np.column_stack(
        [np.cross(basis[0], direction), np.cross(basis[1], direction), np.cross(y, basis[0]), np.cross(y, basis[1])]
    )
    # Pose: d moves y by -d; a turn r moves N (camera axes) by R^T (N_base x r).
    by_pose = by_N @ np.hstack([skew(direction), skew(N_base)])
    cuts = [N[:2] / scale @ J[k] for k in range(2)]
    noise = np.diag([float(c @ seen.covariance_px @ c) for c in cuts])
    return e, by_line, noise + by_pose @ seen.station.base_from_camera.covariance @ by_pose.T


def _check_agreement(chi_square: float, degrees: int, what: str) -> None:
    if chi_square > DISAGREEMENT_CHI_SQUARE + 3.0 * degrees:
        raise NotFound(
            f"the views do not see one {what} (chi-square {chi_square:.0f} on {degrees} degrees of freedom)",
            hint="check that the same thing was picked in every view, and the hand-eye calibration",
            chi_square=round(chi_square, 1),
        )
