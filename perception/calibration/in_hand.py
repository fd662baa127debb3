"""Joint calibration of a camera on the hand from views of known points: mount, target and lens in one fit.

Pixel: u = lens((A X)^-1 Z (p + e)) + s with A = base_from_flange, X = flange_from_camera, Z = base_from_target. X, Z,
the lens, the errors e of the points and two parameters of s (`InHandState.offset`) are estimated together. Prior
knowledge of lens, e and s enters as measurements with standard deviations. The repeatability of the arm is part of the
noise of every view, so the covariance of X includes all these contributions. Covariances are over translation, then
rotation, in the parent's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, matrix_of
from hal.least_squares import Minimum, descend
from perception.calibration.calibration_poses import ROUGHLY
from perception.calibration.in_hand_model import (
    FREE,
    INDEX,
    Beforehand,
    InHandState,
    InHandView,
    chi_square,
    moved,
    noise,
    priors_of,
    residual,
)
from perception.calibration.intrinsics import parameters

LIMIT_M = 0.001  # largest accepted standard deviation of the mount; one known less well is no better than its drawing
LIMIT_RAD = 0.0035
OUTLIER_P = 1e-4  # a view is an outlier if noise gives its residuals with a smaller probability
FEWEST_VIEWS = 4
LEAST_AXIS_SPREAD = 0.02  # mean sin^2 between rotation axes: 8 degrees; with less, one coordinate of X is mostly noise
LEAST_TURN_RAD = 0.05  # smaller rotations between two stations are not used to judge the spread
LEVER_M = 0.1  # distance at which a rotation error of the mount is converted to a shift


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InHandCalibration:
    """Result of the joint calibration.

    Attributes:
        flange_from_camera, base_from_target: with covariance.
        intrinsics, lens_sigma: the lens, and the standard deviation of each parameter in `FREE`.
        target_from_camera: (V, 4, 4) poses of the camera in the used views.
        residuals_px: (V, N, 2) measured minus predicted pixels of the used views.
        rms_px: their root mean square, both coordinates together.
        chi_square, degrees: chi-square of the fit and its degrees of freedom; their ratio is near 1 if the stated noise
        is
            right.
        used: indices of the views kept.
    """

    flange_from_camera: UncertainPose
    base_from_target: UncertainPose
    intrinsics: CameraIntrinsics
    lens_sigma: Array
    target_from_camera: Array
    residuals_px: Array
    rms_px: float
    chi_square: float
    degrees: int
    used: tuple[int, ...]


def calibrate_in_hand(
    views: Sequence[InHandView], points_m: Array, start: InHandState, known: Beforehand,
    *, limit_m: float = LIMIT_M, limit_rad: float = LIMIT_RAD,
) -> InHandCalibration:  # fmt: skip
    """Estimate mount, target pose and lens from four or more views.

    Args:
        views: stations; every view shows all points, in the same order.
        points_m: (N, 3) in the target's frame, as in its drawing.
        start: nominal values; `point_errors_m` is (N, 3) of zeros.
        limit_m, limit_rad: largest accepted standard deviations of the mount, in its worst direction.

    Raises:
        InvalidRequest: too few views, wrong shapes or not finite.
        NotObservable: the hand rotated about one axis only, or the mount stays too uncertain; says what to add.

    Source: the bundle adjustment of Tabb, Ahmad Yousef, Machine Vision and Applications 28, 2017, with priors.
    """
    _check(views, points_m)
    used = list(range(len(views)))
    while True:
        kept = [views[k] for k in used]
        check_turns([view.base_from_flange for view in kept])
        state, minimum = _fit(kept, points_m, start, known)
        errors = [chi_square(view, points_m, state, known) for view in kept]
        worst = int(np.argmax(errors))
        if chdtrc(2 * len(points_m), errors[worst]) > OUTLIER_P or len(used) <= FEWEST_VIEWS:
            break
        del used[worst]
    rest = np.concatenate([residual(views[k], points_m, state, known.disc_m)[0] for k in used])
    # Residuals larger than the stated noise explains make all parameters less certain, in proportion.
    covariance = minimum.covariance * max(1.0, minimum.chi_square / (len(rest) - 12))
    _check_accuracy(covariance, len(used), limit_m, limit_rad)
    return InHandCalibration(
        flange_from_camera=UncertainPose(
            parent_from_child=state.flange_from_camera, covariance=covariance[:6, :6]
        ),
        base_from_target=UncertainPose(
            parent_from_child=state.base_from_target, covariance=covariance[6:12, 6:12]
        ),
        intrinsics=state.intrinsics, lens_sigma=np.sqrt(np.diag(covariance)[12 : 12 + len(FREE)]),
        target_from_camera=np.array([
            (state.base_from_target.inv() * views[k].base_from_flange * state.flange_from_camera).as_matrix() for k in used
        ]),
        residuals_px=-rest.reshape(len(used), -1, 2),
        rms_px=float(np.sqrt(np.mean(rest**2))), chi_square=minimum.chi_square,
        degrees=len(rest) - 12, used=tuple(used),
    )  # fmt: skip


def propose_view(
    done: Sequence[RigidTransform], candidates: Sequence[RigidTransform], points_m: Array, state: InHandState,
    known: Beforehand, *, sigma_px: float = 0.05,
) -> tuple[int, float]:  # fmt: skip
    """Choose the next flange pose: the one after which the mount is known best.

    Args:
        done: base_from_flange of the stations so far.
        candidates: poses from which all points are in view.
        state: current estimate; nominal values suffice.
        sigma_px: expected noise of a point.

    Returns: index into `candidates`, and the standard deviation of the mount with that pose in metres: of its position,
        with rotations converted at a distance of `LEVER_M`.

    Raises:
        InvalidRequest: no candidates.
    """
    if not candidates:
        raise InvalidRequest("no candidate poses", hint="give flange poses from which the target is in view")
    priors = priors_of(state.intrinsics, known, len(points_m))
    beforehand = np.diag(np.concatenate([ROUGHLY**-2.0, priors**-2.0]))
    so_far = sum((_information(pose, points_m, state, known, sigma_px) for pose in done), beforehand)
    weight = np.repeat([1.0, LEVER_M**2], 3)
    scores = []
    for pose in candidates:
        covariance = np.linalg.inv(so_far + _information(pose, points_m, state, known, sigma_px))
        scores.append(float(np.sqrt(np.diag(covariance)[:6] @ weight)))
    best = int(np.argmin(scores))
    return best, scores[best]


def _information(
    flange: RigidTransform, points_m: Array, state: InHandState, known: Beforehand, sigma_px: float
) -> Array:
    """Return the information matrix that one view contributes about the step of the state."""
    nothing = np.zeros((len(points_m), 2))
    covariance = np.tile(sigma_px**2 * np.eye(2), (len(points_m), 1, 1))
    view = InHandView(base_from_flange=flange, pixels_px=nothing, covariance_px=covariance)
    _, J = residual(view, points_m, state, known.disc_m)
    return np.asarray(J.T @ np.linalg.solve(noise(view, points_m, state, known), J))


def _check(views: Sequence[InHandView], points_m: Array) -> None:
    """Check number, shapes and values of the views.

    Raises:
        InvalidRequest: they are not usable.
    """
    if len(views) < FEWEST_VIEWS:
        raise InvalidRequest(f"{len(views)} views; four are the least", hint="take twelve, turned about several axes")
    for k, view in enumerate(views):
        if view.pixels_px.shape != (len(points_m), 2) or view.covariance_px.shape != (len(points_m), 2, 2):
            raise InvalidRequest(f"views[{k}] needs a pixel and a covariance a point", hint="leave that view out")
        if not (np.isfinite(view.pixels_px).all() and np.isfinite(view.covariance_px).all()):
            raise InvalidRequest(f"views[{k}] is not finite", hint="leave that view out")


def _fit(
    views: Sequence[InHandView], points_m: Array, start: InHandState, known: Beforehand
) -> tuple[InHandState, Minimum]:
    """Fit the state by weighted nonlinear least squares with priors."""
    priors = priors_of(start.intrinsics, known, len(points_m))
    believed = parameters(start.intrinsics)[INDEX]
    state = start
    for _ in range(2):  # the weights depend only on levers; those of the first result are accurate enough
        whiten = [np.linalg.inv(np.linalg.cholesky(noise(view, points_m, state, known))) for view in views]

        def linearise(at: InHandState, whiten: list[Array] = whiten) -> tuple[Array, Array]:
            lens = parameters(at.intrinsics)[INDEX] - believed
            surprise = np.concatenate([lens, at.point_errors_m.ravel(), at.offset - start.offset])
            residuals = [surprise / priors]
            rows = [np.hstack([np.zeros((len(priors), 12)), np.diag(1.0 / priors)])]
            for view, W in zip(views, whiten, strict=True):
                r, J = residual(view, points_m, at, known.disc_m)
                residuals.append(W @ r)
                rows.append(W @ J)
            return np.concatenate(residuals), np.vstack(rows)

        state, minimum = descend(state, linearise, moved)
    return state, minimum


def check_turns(flanges: Sequence[RigidTransform]) -> None:
    """Check that the rotations between the stations have different axes.

    Raises:
        NotObservable: they share one axis, so that the shift of X along it is not determined; `details["next_axis"]` is
            the axis (flange frame) about which to rotate next.
    """
    spread, axis = _axis_spread(flanges)
    if spread < LEAST_AXIS_SPREAD:
        words = _across(axis)
        raise NotObservable(
            "the hand turned about one axis only, so the camera's place along that axis stays free",
            hint=f"turn the flange by 20 degrees or more about {words} (flange axes) and look at the target again",
            next_axis=words, axis_spread=round(spread, 4),
        )  # fmt: skip


def _axis_spread(flanges: Sequence[RigidTransform]) -> tuple[float, Array]:
    """Return the spread of the rotation axes between flange poses, and their main axis in the flange frame.

    The spread is the mean sin^2 of their angle from the main axis in the second direction, 0 to 0.5.
    """
    R = np.array([matrix_of(flange) for flange in flanges])
    i, j = np.array(list(combinations(range(len(R)), 2))).T
    turns = Rotation.from_matrix(R[i].swapaxes(1, 2) @ R[j]).as_rotvec()
    angles = np.linalg.norm(turns, axis=1)
    large = angles > LEAST_TURN_RAD
    if not large.any():
        return 0.0, np.array([0.0, 0.0, 1.0])
    # The axis of a small rotation is less certain, so it counts less.
    axes = turns[large] / angles[large, None] * np.minimum(angles[large, None] / 0.3, 1.0)
    values, vectors = np.linalg.eigh(axes.T @ axes / len(axes))
    return float(values[1]), vectors[:, 2]


def _across(axis: Array) -> list[float]:
    """Return a direction across an axis, rounded for people."""
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    return [float(v) for v in np.round(across / np.linalg.norm(across), 2)]


def _check_accuracy(covariance: Array, count: int, limit_m: float, limit_rad: float) -> None:
    """Check that the covariance of the mount, the first six rows of `covariance`, is within the limits.

    Raises:
        NotObservable: the standard deviation in the worst direction is above a limit; `details["next_axis"]` is the
            axis about which to rotate next. `count` is the number of views, for the message.
    """
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    turn = np.linalg.eigvalsh(covariance[3:6, 3:6])
    if np.sqrt(values[2]) <= limit_m and np.sqrt(turn[2]) <= limit_rad:
        return
    words = _across(vectors[:, 2])
    raise NotObservable(
        f"{count} views leave the camera uncertain by {1e3 * np.sqrt(values[2]):.1f} mm along "
        f"{np.round(vectors[:, 2], 2).tolist()} (flange axes) and by {np.degrees(np.sqrt(turn[2])):.2f} deg",
        hint=f"add views turned by 20 degrees or more about {words} (flange axes), or nearer to the target",
        next_axis=words, sigma_mm=round(1e3 * float(np.sqrt(values[2])), 2),
    )  # fmt: skip
