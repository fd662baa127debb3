"""Camera intrinsics from views of known points, on a board or the panel's own lights.

`calibrate_camera` fits two lens models: the radial-tangential one, by maximum likelihood over intrinsics and board
poses, and the paper's bivariate cubic from measured to ideal pixel, for which it reports the bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import disc_offset_px, distort, distortion_jacobian, project, undistort_pixels
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import matrix_of, perturbed, transform
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
        cubic_covariance: (10, 10) of one column of its coefficients, px^2.
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
    cubic_covariance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    """Intrinsics and board poses during the fit."""

    intrinsics: CameraIntrinsics
    poses: tuple[RigidTransform, ...]


def calibrate_camera(
    views: Sequence[BoardView], image_size_px: tuple[int, int], *, free: Sequence[str] = BOARD_FREE,
    start: CameraIntrinsics | None = None,
) -> CameraCalibration:  # fmt: skip
    """Estimate intrinsics, lens and board poses from three or more views.

    Args:
        views: known points in images; the boards must be flat unless `start` is given. `LIGHTS_FREE` suits four lights.
        image_size_px: (width, height).
        free: which of `NAMES` to fit; the others keep their value in `start`, or 0 for the lens.
        start: rough intrinsics; if None, they are computed from the views (Zhang).

    Raises:
        InvalidRequest: too few views or points, unknown names, not finite.
        NotObservable: the views are too similar, so that focal length or centre is uncertain; the hint says how to add
            views.

    Source: Zhang, IEEE PAMI 22(11), 2000.
    """
    _check(views, free)
    guess = start if start is not None else _zhang(views, image_size_px)
    poses = tuple(_first_pose(view, guess) for view in views)
    index = [NAMES.index(name) for name in NAMES if name in free]
    # The first fit is without distortion, over focal lengths and poses only; the second is over all parameters.
    state = _State(intrinsics=guess, poses=poses)
    if start is None:
        state, _ = _fit(views, state, [i for i in index if i < 2])
    state, _ = _fit(views, state, index)
    views = [_cleaned(view, pose, state.intrinsics) for view, pose in zip(views, state.poses, strict=True)]
    state, minimum = _fit(views, state, index)
    n = len(index)
    degrees = 2 * sum(len(view.points_m) for view in views) - n - 6 * len(views)
    # Residuals larger than the stated noise explains make all parameters less certain, in proportion.
    covariance = minimum.covariance[:n, :n] * max(1.0, minimum.chi_square / degrees)
    _check_accuracy(covariance, [NAMES[i] for i in index], state.intrinsics)
    residuals = tuple(
        view.pixels_px - project(pose.apply(view.points_m), state.intrinsics)
        for view, pose in zip(views, state.poses, strict=True)
    )
    stacked = np.concatenate(residuals)
    cubic, cubic_covariance = fit_cubic(views, state.intrinsics, state.poses)
    return CameraCalibration(
        intrinsics=state.intrinsics, names=tuple(NAMES[i] for i in index), covariance=covariance,
        rms_px=float(np.sqrt(np.mean(stacked**2))), residuals_px=residuals, chi_square=minimum.chi_square,
        degrees=degrees, board_poses=state.poses, cubic=cubic,
        cubic_covariance=cubic_covariance,
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


def _homography(view: BoardView) -> Array:
    """Return the homography (3, 3) from board x, y to pixels, by direct linear transform with Hartley's scaling."""
    plane, pixels = view.points_m[:, :2], view.pixels_px
    Ta, Tb = _scaling(plane), _scaling(pixels)
    a = np.column_stack([plane, np.ones(len(plane))]) @ Ta.T
    b = np.column_stack([pixels, np.ones(len(pixels))]) @ Tb.T
    zero = np.zeros_like(a)
    rows = np.vstack([np.hstack([a, zero, -b[:, :1] * a]), np.hstack([zero, a, -b[:, 1:2] * a])])
    H = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return np.asarray(np.linalg.inv(Tb) @ H @ Ta)


def _scaling(points: Array) -> Array:
    """Return the similarity (3, 3) that moves the centroid of points (N, 2) to zero and their mean square to one."""
    centre = points.mean(axis=0)
    size = float(np.sqrt(np.mean((points - centre) ** 2))) or 1.0
    return np.array([[1 / size, 0, -centre[0] / size], [0, 1 / size, -centre[1] / size], [0, 0, 1]])


def _zhang(views: Sequence[BoardView], size: tuple[int, int]) -> CameraIntrinsics:
    """Compute focal lengths from the homographies, with the principal point in the middle of the image.

    With K^-1 H = (h1 h2 h3): h1 . h2 = 0 and |h1| = |h2| are linear in 1/fx^2 and 1/fy^2.
    """
    width, height = size
    centre = np.array([[1, 0, -(width - 1) / 2.0], [0, 1, -(height - 1) / 2.0], [0, 0, 1]])
    rows, values = [], []
    for view in views:
        H = centre @ _homography(view)
        H = H / np.linalg.norm(H[:, :2])
        (a1, b1, c1), (a2, b2, c2) = H[:, 0], H[:, 1]
        rows += [[a1 * a2, b1 * b2], [a1**2 - a2**2, b1**2 - b2**2]]
        values += [-c1 * c2, c2**2 - c1**2]
    inverse = np.linalg.lstsq(np.array(rows) * width**-2, np.array(values), rcond=None)[0] * width**-2
    focal = 1.2 * width * np.ones(2)  # a usual lens; frontal views do not determine the focal lengths
    if (inverse > 0).all():
        found = 1.0 / np.sqrt(inverse)
        focal = np.where((found > 0.3 * width) & (found < 8.0 * width), found, focal)
    return CameraIntrinsics(
        width_px=width, height_px=height, fx_px=float(focal[0]), fy_px=float(focal[1]), cx_px=(width - 1) / 2.0,
        cy_px=(height - 1) / 2.0,
    )  # fmt: skip


def _first_pose(view: BoardView, intrinsics: CameraIntrinsics) -> RigidTransform:
    """Return camera_from_board from the homography of the undistorted pixels (flat), else by OpenCV's SQPNP."""
    ideal = undistort_pixels(view.pixels_px, intrinsics)
    K = np.array([
        [intrinsics.fx_px, 0, intrinsics.cx_px], [0, intrinsics.fy_px, intrinsics.cy_px], [0, 0, 1.0]
    ])  # fmt: skip
    if np.ptp(view.points_m[:, 2]) > 1e-9:
        import cv2

        _, turn, shift = cv2.solvePnP(view.points_m, ideal, K, None, flags=cv2.SOLVEPNP_SQPNP)
        return transform(Rotation.from_rotvec(np.asarray(turn).ravel()).as_matrix(), np.asarray(shift).ravel())
    h = np.linalg.inv(K) @ _homography(BoardView(points_m=view.points_m, pixels_px=ideal, sigma_px=view.sigma_px))
    h = h / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    t = h[:, 2]
    if t[2] < 0:
        h, t = -h, -t
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    height = float(view.points_m[0, 2])
    return transform(R, t - R @ [0.0, 0.0, height])


def parameters(intrinsics: CameraIntrinsics) -> Array:
    """Return the values (9,) of `NAMES`."""
    return np.array([
        intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *intrinsics.distortion
    ])  # fmt: skip


def with_parameters(intrinsics: CameraIntrinsics, values: Array) -> CameraIntrinsics:
    """Return the intrinsics with the values (9,) of `NAMES`."""
    fx, fy, cx, cy, *lens = (float(v) for v in values)
    return CameraIntrinsics(
        width_px=intrinsics.width_px, height_px=intrinsics.height_px, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy,
        distortion=(lens[0], lens[1], lens[2], lens[3], lens[4]),
    )  # fmt: skip


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


def _projection(view: BoardView, pose: RigidTransform, intrinsics: CameraIntrinsics) -> tuple[Array, Array, Array]:
    """Return the pixels (N, 2) and their derivatives with respect to the intrinsics (2N, 9) and to the pose (2N, 6)."""
    turned = view.points_m @ matrix_of(pose).T
    q = turned + pose.translation
    z = np.maximum(q[:, 2], 1e-6)
    n = q[:, :2] / z[:, None]
    d = distort(n, intrinsics)
    focal = np.array([intrinsics.fx_px, intrinsics.fy_px])
    by_lens = lens_jacobian(n, intrinsics)
    by_point = np.zeros((len(n), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
    by_point[:, :, 2] = -n / z[:, None]
    by_point = focal[:, None] * (distortion_jacobian(n, intrinsics) @ by_point)
    by_turn = np.cross(turned[:, None, :], by_point)  # a . (r x y) = r . (y x a)
    by_pose = np.concatenate([by_point, by_turn], axis=2)
    pixels = d * focal + [intrinsics.cx_px, intrinsics.cy_px]
    return np.asarray(pixels), by_lens.reshape(-1, 9), by_pose.reshape(-1, 6)


def _fit(views: Sequence[BoardView], start: _State, index: list[int]) -> tuple[_State, Minimum]:
    """Fit the parameters `index` of `NAMES` and all board poses by nonlinear least squares.

    Raises:
        NotObservable: the views do not determine them.
    """
    n = len(index)

    def linearise(state: _State) -> tuple[Array, Array]:
        residuals, rows = [], []
        for k, (view, pose) in enumerate(zip(views, state.poses, strict=True)):
            pixels, by_lens, by_pose = _projection(view, pose, state.intrinsics)
            row = np.zeros((2 * len(pixels), n + 6 * len(views)))
            row[:, :n] = by_lens[:, index]
            row[:, n + 6 * k : n + 6 * k + 6] = by_pose
            residuals.append((pixels - view.pixels_px).ravel() / view.sigma_px)
            rows.append(row / view.sigma_px)
        return np.concatenate(residuals), np.vstack(rows)

    def move(state: _State, step: Array) -> _State:
        values = parameters(state.intrinsics)
        values[index] += step[:n]
        poses = tuple(perturbed(pose, step[n + 6 * k : n + 6 * k + 6]) for k, pose in enumerate(state.poses))
        return _State(intrinsics=with_parameters(state.intrinsics, values), poses=poses)

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
