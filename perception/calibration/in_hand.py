"""Joint calibration of a camera on the hand from views of known points: mount, target and lens in one fit.

Pixel: u = lens((A X)^-1 Z (p + e)) + s with A = base_from_flange, X = flange_from_camera, Z = base_from_target. X, Z,
the lens, the errors e of the points and two parameters of s (`InHandState.offset`) are estimated together. Prior
knowledge of lens, e and s enters as measurements with standard deviations. The repeatability of the arm is part of the
noise of every view, so the covariance of X includes all these contributions. Covariances are over translation, then
rotation, in the parent's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtrc

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import disc_offset_px, project_with_jacobian
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, certain, matrix_of, perturbed, skew
from hal.least_squares import Minimum, descend
from perception.calibration.hand_eye import HandEyeView, check_accuracy, check_turns
from perception.calibration.intrinsics import NAMES, lens_jacobian, parameters, with_parameters

FREE = ("fx", "fy", "cx", "cy", "k1")  # lens parameters that are estimated
INDEX = [NAMES.index(name) for name in FREE]
LIMIT_M = 0.001  # largest accepted standard deviation of the mount; one known less well is no better than its drawing
LIMIT_RAD = 0.0035
OUTLIER_P = 1e-4  # a view is an outlier if noise gives its residuals with a smaller probability
FEWEST_VIEWS = 4
# Prior standard deviations of mount and target in m and rad, so that the first views can be compared.
ROUGHLY = np.repeat([0.1, 0.3, 0.1, 0.3], 3)
LEVER_M = 0.1  # distance at which a rotation error of the mount is converted to a shift


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InHandView:
    """One station: flange pose as the arm reports it, points in the image (N, 2), and their covariances (N, 2, 2)."""

    base_from_flange: RigidTransform
    pixels_px: Array
    covariance_px: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InHandState:
    """The quantities that are estimated.

    Attributes:
        flange_from_camera, base_from_target, intrinsics: X, Z and the lens.
        point_errors_m: (N, 3) errors of the target's points, target frame.
        offset: (2,) model of the distance between the middle of a lamp and that of its bright spot, common to all
        views.
            The first is a factor of the offset of a flat disc seen obliquely (`disc_offset_px`), which is towards its
            near side; the second is in px outwards in the image, per squared tangent of the angle from the optical
            axis. They differ from 1 and 0 because a lamp has a body and a glow, and a lens shades.
    """

    flange_from_camera: RigidTransform
    base_from_target: RigidTransform
    intrinsics: CameraIntrinsics
    point_errors_m: Array
    offset: Array = field(default_factory=lambda: np.array([1.0, 0.0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beforehand:
    """Standard deviations of the prior knowledge, and of the arm.

    Attributes:
        focal_ratio, centre_px, k1: of the lens.
        point_m: of each coordinate of the target's points.
        disc_m: radius of the flat disc whose middle a point is; 0 for a corner or a cross. It is no standard deviation.
        offset: of both parameters of `InHandState.offset`.
        arm_m, arm_rad: repeatability of the arm, independent at every station.
    """

    focal_ratio: float
    centre_px: float
    k1: float
    point_m: float = 1e-4
    arm_m: float = 1e-4
    arm_rad: float = 1e-4
    disc_m: float = 0.0
    offset: tuple[float, float] = (2.0, 0.1)


# Accuracy of a lens that is known from its data sheet.
UNKNOWN_LENS = Beforehand(focal_ratio=0.02, centre_px=15.0, k1=0.1)


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
        check_turns([HandEyeView(base_from_flange=v.base_from_flange, camera_from_target=certain(v.base_from_flange))
                     for v in kept])  # fmt: skip
        state, minimum = _fit(kept, points_m, start, known)
        errors = [_chi_square(view, points_m, state, known) for view in kept]
        worst = int(np.argmax(errors))
        if chdtrc(2 * len(points_m), errors[worst]) > OUTLIER_P or len(used) <= FEWEST_VIEWS:
            break
        del used[worst]
    rest = np.concatenate([_residual(views[k], points_m, state, known.disc_m)[0] for k in used])
    # Residuals larger than the stated noise explains make all parameters less certain, in proportion.
    covariance = minimum.covariance * max(1.0, minimum.chi_square / (len(rest) - 12))
    check_accuracy(covariance, len(used), limit_m=limit_m, limit_rad=limit_rad)
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
    priors = _priors(state.intrinsics, known, len(points_m))
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
    _, J = _residual(view, points_m, state, known.disc_m)
    return np.asarray(J.T @ np.linalg.solve(_noise(view, points_m, state, known), J))


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
    priors = _priors(start.intrinsics, known, len(points_m))
    believed = parameters(start.intrinsics)[INDEX]
    state = start
    for _ in range(2):  # the weights depend only on levers; those of the first result are accurate enough
        whiten = [np.linalg.inv(np.linalg.cholesky(_noise(view, points_m, state, known))) for view in views]

        def linearise(at: InHandState, whiten: list[Array] = whiten) -> tuple[Array, Array]:
            lens = parameters(at.intrinsics)[INDEX] - believed
            surprise = np.concatenate([lens, at.point_errors_m.ravel(), at.offset - start.offset])
            residuals = [surprise / priors]
            rows = [np.hstack([np.zeros((len(priors), 12)), np.diag(1.0 / priors)])]
            for view, W in zip(views, whiten, strict=True):
                r, J = _residual(view, points_m, at, known.disc_m)
                residuals.append(W @ r)
                rows.append(W @ J)
            return np.concatenate(residuals), np.vstack(rows)

        state, minimum = descend(state, linearise, _moved)
    return state, minimum


def _priors(lens: CameraIntrinsics, known: Beforehand, count: int) -> Array:
    """Return prior standard deviations of lens, point coordinates and offset, in the order of the state's step."""
    of_lens = [
        known.focal_ratio * lens.fx_px,
        known.focal_ratio * lens.fy_px,
        known.centre_px,
        known.centre_px,
        known.k1,
    ]
    return np.array(of_lens + [known.point_m] * (3 * count) + list(known.offset))


def _moved(state: InHandState, step: Array) -> InHandState:
    """Return the state after a step: mount (6), target (6), lens, point errors (3N) and offset (2)."""
    values = parameters(state.intrinsics)
    values[INDEX] += step[12 : 12 + len(FREE)]
    return InHandState(
        flange_from_camera=perturbed(state.flange_from_camera, step[:6]),
        base_from_target=perturbed(state.base_from_target, step[6:12]),
        intrinsics=with_parameters(state.intrinsics, values),
        point_errors_m=state.point_errors_m + step[12 + len(FREE) : -2].reshape(-1, 3),
        offset=state.offset + step[-2:],
    )


def _residual(view: InHandView, points_m: Array, state: InHandState, disc_m: float) -> tuple[Array, Array]:
    """Return the residuals (2N,), predicted minus measured pixels, and their Jacobian (2N, p) over the state's step."""
    Rx, Rz = matrix_of(state.flange_from_camera), matrix_of(state.base_from_target)
    Ra = matrix_of(view.base_from_flange)
    turned = (points_m + state.point_errors_m) @ Rz.T
    in_flange = (turned + state.base_from_target.translation - view.base_from_flange.translation) @ Ra
    q = (in_flange - state.flange_from_camera.translation) @ Rx
    pixels, by_q = project_with_jacobian(q, state.intrinsics)
    n = len(points_m)
    camera_from_base = (Ra @ Rx).T
    tangent = q[:, :2] / q[:, 2:]
    J = np.zeros((n, 2, 12 + len(FREE) + 3 * n + 2))
    lever = [skew(p) for p in in_flange - state.flange_from_camera.translation]
    J[:, :, :3], J[:, :, 3:6] = -by_q @ Rx.T, by_q @ (Rx.T @ np.array(lever))  # - r x f = [f]x r
    J[:, :, 6:9] = by_q @ camera_from_base
    J[:, :, 9:12] = by_q @ (camera_from_base @ np.array([-skew(p) for p in turned]))
    J[:, :, 12 : 12 + len(FREE)] = lens_jacobian(tangent, state.intrinsics)[:, :, INDEX]
    by_point = by_q @ camera_from_base @ Rz
    for k in range(n):
        J[k, :, 12 + len(FREE) + 3 * k :][:, :3] = by_point[k]
    # The offsets are some hundredths of a pixel, so their derivatives with respect to the poses are neglected.
    camera_from_target = (view.base_from_flange * state.flange_from_camera).inv() * state.base_from_target
    J[:, :, -2] = disc_offset_px(points_m, disc_m, camera_from_target, state.intrinsics)
    J[:, :, -1] = tangent * np.linalg.norm(tangent, axis=1, keepdims=True)
    return (pixels + J[:, :, -2:] @ state.offset - view.pixels_px).ravel(), J.reshape(2 * n, -1)


def _noise(view: InHandView, points_m: Array, state: InHandState, known: Beforehand) -> Array:
    """Return the covariance (2N, 2N) of a view's residuals: noise of the pixels, and the common effect of the arm."""
    Rx, Rz = matrix_of(state.flange_from_camera), matrix_of(state.base_from_target)
    Ra = matrix_of(view.base_from_flange)
    world = (points_m + state.point_errors_m) @ Rz.T + state.base_from_target.translation
    from_flange = world - view.base_from_flange.translation
    _, by_q = project_with_jacobian(
        (from_flange @ Ra - state.flange_from_camera.translation) @ Rx, state.intrinsics
    )  # fmt: skip
    camera_from_base = (Ra @ Rx).T
    by_arm = np.concatenate(
        [-by_q @ camera_from_base, by_q @ (camera_from_base @ np.array([skew(p) for p in from_flange]))], axis=2
    ).reshape(-1, 6)
    arm = np.diag([known.arm_m**2] * 3 + [known.arm_rad**2] * 3)
    noise = by_arm @ arm @ by_arm.T
    for k, covariance in enumerate(view.covariance_px):
        noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += covariance
    return np.asarray(noise)


def _chi_square(view: InHandView, points_m: Array, state: InHandState, known: Beforehand) -> float:
    """Return the chi-square of one view."""
    r, _ = _residual(view, points_m, state, known.disc_m)
    return float(r @ np.linalg.solve(_noise(view, points_m, state, known), r))
