"""Camera intrinsics from views of known points, on a board or the panel's own lights.

`calibrate_camera` fits two lens models: the radial-tangential one, by maximum likelihood over intrinsics and board
poses, and the paper's bivariate cubic from measured to ideal pixel, for which it reports the bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import disc_offset_px, distort, project, project_with_jacobian, undistort_pixels
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import matrix_of, perturbed
from hal.least_squares import Minimum, descend
from perception.calibration.boards import FEWEST_POINTS, BoardView
from perception.calibration.cubic_lens import CubicLens, fit_cubic

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
BOARD_FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")  # k3 needs points in the corners of a wide lens
LIGHTS_FREE = ("fx", "fy", "cx", "cy", "k1")  # for four points per view
FOCAL_LIMIT = 0.01  # largest accepted standard deviation, relative to the focal length
CENTRE_LIMIT = 0.02  # largest accepted standard deviation, relative to the image width
STRAY = 6.0  # outliers are beyond this multiple of sigma and of the view's median error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration:
    """Result of a calibration of the intrinsics.

    Attributes:
        intrinsics: pinhole and radial-tangential lens.
        names, covariance: the parameters that were fitted, and their (n, n) covariance (px, or 1 for the lens).
        rms_px: root mean square of all residuals, both coordinates together.
        residuals_px: (N, 2) per view.
        chi_square, degrees: chi-square with the stated noise of the points, and degrees of freedom.
        board_poses: camera_from_board of every view.
        cubic: the paper's correction, fitted to the same points; its bias is the part of the distortion over the image
        that
            it cannot represent.
    """

    intrinsics: CameraIntrinsics
    names: tuple[str, ...]
    covariance: Array
    rms_px: float
    residuals_px: tuple[Array, ...]
    chi_square: float
    degrees: int
    board_poses: tuple[RigidTransform, ...]
    cubic: CubicLens


State = tuple[CameraIntrinsics, tuple[RigidTransform, ...]]
"""Intrinsics and board poses during the fit."""


def calibrate_camera(
    views: Sequence[BoardView], image_size_px: tuple[int, int], *, free: Sequence[str] = BOARD_FREE
) -> CameraCalibration:
    """Estimate intrinsics, lens and board poses from three or more views.

    Args:
        views: known points of flat boards in images. `LIGHTS_FREE` suits four lights.
        image_size_px: (width, height).
        free: which of `NAMES` to fit; of the lens the others are 0.

    Raises:
        InvalidRequest: too few views or points, unknown names, not finite.
        NotObservable: the views are too similar, so that focal length or centre is uncertain; the hint says how to add
            views.

    Source: Zhang, IEEE PAMI 22(11), 2000.
    """
    _check(views, free)
    guess = _rough(views, image_size_px)
    state: State = (guess, tuple(_first_pose(view, guess) for view in views))
    index = [NAMES.index(name) for name in NAMES if name in free]
    # The first fit is without distortion, over focal lengths and poses only; the second is over all parameters.
    state, _ = _fit(views, state, [i for i in index if i < 2])
    state, _ = _fit(views, state, index)
    views = [_cleaned(view, pose, state[0]) for view, pose in zip(views, state[1], strict=True)]
    (intrinsics, poses), minimum = _fit(views, state, index)
    n = len(index)
    degrees = 2 * sum(len(view.points_m) for view in views) - n - 6 * len(views)
    # Residuals larger than the stated noise explains make all parameters less certain, in proportion.
    covariance = minimum.covariance[:n, :n] * max(1.0, minimum.chi_square / degrees)
    _check_accuracy(covariance, [NAMES[i] for i in index], intrinsics)
    residuals = tuple(
        view.pixels_px - project(pose.apply(view.points_m), intrinsics) for view, pose in zip(views, poses, strict=True)
    )
    stacked = np.concatenate(residuals)
    return CameraCalibration(
        intrinsics=intrinsics, names=tuple(NAMES[i] for i in index), covariance=covariance,
        rms_px=float(np.sqrt(np.mean(stacked**2))), residuals_px=residuals, chi_square=minimum.chi_square,
        degrees=degrees, board_poses=poses, cubic=fit_cubic(views, intrinsics, poses),
    )  # fmt: skip


def _cleaned(view: BoardView, pose: RigidTransform, intrinsics: CameraIntrinsics) -> BoardView:
    """Return the view without outlying points, and with the pixels of discs corrected to their true middles."""
    errors_px = np.linalg.norm(view.pixels_px - project(pose.apply(view.points_m), intrinsics), axis=1)
    near = errors_px <= STRAY * max(view.sigma_px, float(np.median(errors_px)))
    if near.sum() < FEWEST_POINTS:
        near[:] = True  # with four lights it is impossible to tell which one is the outlier
    points_m, pixels_px = view.points_m[near], view.pixels_px[near]
    if view.disc_m > 0.0:
        pixels_px = pixels_px - disc_offset_px(points_m, view.disc_m, pose, intrinsics)
    return replace(view, points_m=points_m, pixels_px=pixels_px)


def _check(views: Sequence[BoardView], free: Sequence[str]) -> None:
    """Check the views and the names of the parameters.

    Raises:
        InvalidRequest: they are not usable.
    """
    unknown = set(free) - set(NAMES)
    if unknown:
        raise InvalidRequest(f"no parameter called {sorted(unknown)[0]!r}", hint=f"known: {', '.join(NAMES)}")
    if len(views) < 3:
        raise InvalidRequest(f"{len(views)} views; three are the least", hint="take twelve from different sides")
    for k, view in enumerate(views):
        if len(view.points_m) < 4 or view.pixels_px.shape != (len(view.points_m), 2):
            raise InvalidRequest(f"views[{k}] needs four points or more with a pixel each", hint="leave that view out")
        if not (np.isfinite(view.points_m).all() and np.isfinite(view.pixels_px).all()):
            raise InvalidRequest(f"views[{k}] is not finite", hint="leave that view out")
    if sum(2 * len(view.points_m) - 6 for view in views) < len(free):
        raise InvalidRequest("fewer measurements than unknowns", hint="add views, or fit fewer parameters")


def _rough(views: Sequence[BoardView], size: tuple[int, int]) -> CameraIntrinsics:
    """Return focal lengths from the views of flat boards (Zhang), with the principal point in the middle of the image."""
    width, height = size
    points = [np.column_stack([v.points_m[:, :2], np.zeros(len(v.points_m))]).astype(np.float32) for v in views]
    pixels = [view.pixels_px.astype(np.float32) for view in views]
    focal = np.diag(np.asarray(cv2.initCameraMatrix2D(points, pixels, size, aspectRatio=0.0), float))[:2]
    # Frontal views do not determine the focal lengths; 1.2 widths is a usual lens.
    fx, fy = np.where((focal > 0.3 * width) & (focal < 8.0 * width), focal, 1.2 * width)
    return CameraIntrinsics(
        width_px=width,
        height_px=height,
        fx_px=float(fx),
        fy_px=float(fy),
        cx_px=(width - 1) / 2.0,
        cy_px=(height - 1) / 2.0,
    )


def _first_pose(view: BoardView, intrinsics: CameraIntrinsics) -> RigidTransform:
    """Return a rough camera_from_board."""
    K = np.array([[intrinsics.fx_px, 0, intrinsics.cx_px], [0, intrinsics.fy_px, intrinsics.cy_px], [0, 0, 1.0]])
    ideal = undistort_pixels(view.pixels_px, intrinsics)
    _, turn, shift = cv2.solvePnP(view.points_m, ideal, K, None, flags=cv2.SOLVEPNP_SQPNP)
    return RigidTransform.from_components(np.asarray(shift).ravel(), Rotation.from_rotvec(np.asarray(turn).ravel()))


def parameters(intrinsics: CameraIntrinsics) -> Array:
    """Return the values (9,) of `NAMES`."""
    return np.array([
        intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *intrinsics.distortion
    ])  # fmt: skip


def with_parameters(intrinsics: CameraIntrinsics, values: Array) -> CameraIntrinsics:
    """Return the intrinsics with the values (9,) of `NAMES`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(v) for v in values)
    lens = (k1, k2, p1, p2, k3)
    return replace(intrinsics, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=lens)


def lens_jacobian(normalised: Array, intrinsics: CameraIntrinsics) -> Array:
    """Return the derivatives (N, 2, 9) of pixels with respect to `NAMES`, for undistorted normalised points (N, 2)."""
    x, y = normalised.T
    r2 = x * x + y * y
    d = distort(normalised, intrinsics)
    focal = np.array([intrinsics.fx_px, intrinsics.fy_px])
    by_lens = np.zeros((len(normalised), 2, 9))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = d[:, 0], d[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    bend = np.stack([
        np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=1),
        np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=1),
    ], axis=1)  # fmt: skip
    by_lens[:, :, 4:] = focal[:, None] * bend
    return by_lens


def _fit(views: Sequence[BoardView], start: State, index: list[int]) -> tuple[State, Minimum]:
    """Fit the parameters `index` of `NAMES` and all board poses by nonlinear least squares.

    Raises:
        NotObservable: the views do not determine them.
    """
    n = len(index)

    def linearise(state: State) -> tuple[Array, Array]:
        intrinsics, poses = state
        residuals, rows = [], []
        for k, (view, pose) in enumerate(zip(views, poses, strict=True)):
            turned = view.points_m @ matrix_of(pose).T
            q = turned + pose.translation
            pixels, by_point = project_with_jacobian(q, intrinsics)
            row = np.zeros((len(q), 2, n + 6 * len(views)))
            row[:, :, :n] = lens_jacobian(q[:, :2] / q[:, 2:], intrinsics)[:, :, index]
            row[:, :, n + 6 * k : n + 6 * k + 3] = by_point
            row[:, :, n + 6 * k + 3 : n + 6 * k + 6] = np.cross(turned[:, None], by_point)  # a . (r x y) = r . (y x a)
            residuals.append((pixels - view.pixels_px).ravel() / view.sigma_px)
            rows.append(row.reshape(2 * len(q), -1) / view.sigma_px)
        return np.concatenate(residuals), np.vstack(rows)

    def move(state: State, step: Array) -> State:
        intrinsics, poses = state
        values = parameters(intrinsics)
        values[index] += step[:n]
        moved = (perturbed(pose, step[n + 6 * k : n + 6 * k + 6]) for k, pose in enumerate(poses))
        return with_parameters(intrinsics, values), tuple(moved)

    try:
        return descend(start, linearise, move)
    except NotObservable as error:
        raise NotObservable(
            "the views are too alike to tell the focal length from the distance", hint=HINT, **error.details
        ) from error


HINT = "tilt the board (or the hand) by 20 to 40 degrees in several directions, at two distances, up to the corners"


def _check_accuracy(covariance: Array, names: list[str], intrinsics: CameraIntrinsics) -> None:
    """Check that focal lengths and principal point are certain enough.

    Raises:
        NotObservable: one of them is not.
    """
    limits = {"fx": FOCAL_LIMIT * intrinsics.fx_px, "fy": FOCAL_LIMIT * intrinsics.fy_px,
              "cx": CENTRE_LIMIT * intrinsics.width_px, "cy": CENTRE_LIMIT * intrinsics.width_px}  # fmt: skip
    sigma = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    for name, limit in limits.items():
        if name in sigma and sigma[name] > limit:
            raise NotObservable(
                f"the views leave {name} uncertain by {sigma[name]:.1f} px (at most {limit:.1f})", hint=HINT,
                parameter=name, sigma_px=round(float(sigma[name]), 2),
            )  # fmt: skip
