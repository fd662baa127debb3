"""Hand-eye calibration of the camera's mount and the target's pose from views of one target: A_i X B_i = Z.

A_i = base_from_flange, X = flange_from_camera, B_i = camera_from_target, Z = base_from_target. A closed-form solution
is the start of a maximum-likelihood fit of X and Z together, weighted by the covariance of every B_i and of the arm.
Covariances are over translation, then rotation, in the parent's axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, matrix_of, perturbed, transform
from hal.least_squares import Minimum, descend
from perception.calibration.hand_eye_equation import HandEyeView, Stations, chi_squares, jacobians, noise, residuals

LEAST_AXIS_SPREAD = 0.02  # mean sin^2 between rotation axes: 8 degrees; with less, one coordinate of X is mostly noise
LEAST_TURN_RAD = 0.05  # smaller rotations between two stations are not used to judge the spread
LIMIT_M = 0.002  # largest accepted standard deviation of the mount's position, in its worst direction
LIMIT_RAD = 0.01  # the same for its orientation
OUTLIER_CHI_SQUARE = 22.5  # a chi-square variable with 6 degrees of freedom exceeds it with a probability of 0.1 %


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HandEye:
    """Result of the hand-eye calibration.

    Attributes:
        flange_from_camera, base_from_target: X and Z with their 6x6 covariances.
        covariance: 12x12 of X and Z together.
        chi_square, degrees: chi-square of the fit and its degrees of freedom; their ratio is near 1 if the stated noise
        is
            right.
        residuals: (N, 6) difference between A_i X B_i and Z, base axes, m and rad.
        used: indices of the views kept; the others are outliers (`OUTLIER_CHI_SQUARE`).
    """

    flange_from_camera: UncertainPose
    base_from_target: UncertainPose
    covariance: Array
    chi_square: float
    degrees: int
    residuals: Array
    used: tuple[int, ...]


def calibrate_hand_eye(
    views: Sequence[HandEyeView], *, arm_sigma_m: float = 1e-4, arm_sigma_rad: float = 1e-4
) -> HandEye:
    """Estimate X and Z from three or more views between which the hand has rotated about different axes.

    Args:
        views: stations; the covariance of `camera_from_target` determines their weight.
        arm_sigma_m, arm_sigma_rad: repeatability of the arm, added to every station.

    Raises:
        InvalidRequest: fewer than three views.
        NotObservable: the hand rotated about one axis only (or not at all), or the result is less certain than
        `LIMIT_M`,
            `LIMIT_RAD`; the message says what to do, and `details["next_axis"]` is the axis (flange frame) about which
            to rotate next.

    Source: Park, Martin, IEEE TRA 10(5), 1994 (closed form); Dornaika, Horaud, IEEE TRA 14(4), 1998 (A X B = Z).
    """
    if len(views) < 3:
        raise InvalidRequest(f"{len(views)} views; three are the least", hint="take twelve, turned about several axes")
    check_turns(views)
    arm = np.diag([arm_sigma_m**2] * 3 + [arm_sigma_rad**2] * 3)
    used = list(range(len(views)))
    while True:
        kept = [views[k] for k in used]
        stack = Stations.of(kept)
        (x, z), minimum = _fit(stack, _closed_form(stack), arm)
        errors = chi_squares(stack, x, z, arm)
        worst = int(np.argmax(errors))
        if errors[worst] < OUTLIER_CHI_SQUARE or len(used) <= 4:
            break
        del used[worst]
        check_turns([views[k] for k in used])
    check_accuracy(minimum.covariance, len(kept))
    return HandEye(
        flange_from_camera=UncertainPose(parent_from_child=x, covariance=minimum.covariance[:6, :6]),
        base_from_target=UncertainPose(parent_from_child=z, covariance=minimum.covariance[6:, 6:]),
        covariance=minimum.covariance, chi_square=minimum.chi_square, degrees=6 * len(used) - 12,
        residuals=residuals(Stations.of(views), x, z), used=tuple(used),
    )  # fmt: skip


def check_turns(views: Sequence[HandEyeView]) -> None:
    """Check that the rotations between the stations have different axes.

    Raises:
        NotObservable: they share one axis, so that the shift of X along it is not determined; `details["next_axis"]` is
        the
            axis about which to rotate next.
    """
    spread, axis = _axis_spread([view.base_from_flange for view in views])
    if spread < LEAST_AXIS_SPREAD:
        next_axis = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        next_axis /= np.linalg.norm(next_axis)
        words = np.round(next_axis, 2).tolist()
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
    turns, _ = _relative_turns(R)
    angles = np.linalg.norm(turns, axis=1)
    large = angles > LEAST_TURN_RAD
    if not large.any():
        return 0.0, np.array([0.0, 0.0, 1.0])
    # The axis of a small rotation is less certain, so it counts less.
    axes = turns[large] / angles[large, None] * np.minimum(angles[large, None] / 0.3, 1.0)
    values, vectors = np.linalg.eigh(axes.T @ axes / len(axes))
    return float(values[1]), vectors[:, 2]


def _relative_turns(R: Array) -> tuple[Array, Array]:
    """Return the rotation vectors (P, 3) of R_i^T R_j for every pair, and the pairs (P, 2)."""
    pairs = np.array(list(combinations(range(len(R)), 2)))
    relative = R[pairs[:, 0]].swapaxes(1, 2) @ R[pairs[:, 1]]
    return np.asarray(Rotation.from_matrix(relative).as_rotvec()), pairs


def _closed_form(stack: Stations) -> tuple[RigidTransform, RigidTransform]:
    """Return X and Z in closed form (Park and Martin).

    Aligns the rotation vectors of A_ij and B_ij, the motions between two stations, then solves linearly for the
    translations.
    """
    turns_a, pairs = _relative_turns(stack.Ra)
    turns_b, _ = _relative_turns(stack.Rb.swapaxes(1, 2))
    rx = Rotation.align_vectors(turns_a, turns_b)[0]
    i, j = pairs.T
    Rij = stack.Ra[i].swapaxes(1, 2) @ stack.Ra[j]
    tij = np.einsum("nji,nj->ni", stack.Ra[i], stack.ta[j] - stack.ta[i])
    back = stack.Rb[i] @ stack.Rb[j].swapaxes(1, 2)
    t_b = stack.tb[i] - np.einsum("nij,nj->ni", back, stack.tb[j])
    rows = (Rij - np.eye(3)).reshape(-1, 3)  # (R_a - I) t_x = R_x t_b - t_a
    tx = np.linalg.lstsq(rows, (rx.apply(t_b) - tij).ravel(), rcond=None)[0]
    x = RigidTransform.from_components(tx, rx)
    shift = np.einsum("nij,nj->ni", stack.Ra, rx.apply(stack.tb) + tx) + stack.ta
    mean = Rotation.from_matrix(stack.Ra @ rx.as_matrix() @ stack.Rb).mean()
    return x, RigidTransform.from_components(shift.mean(axis=0), mean)


def _fit(
    stack: Stations, start: tuple[RigidTransform, RigidTransform], arm: Array
) -> tuple[tuple[RigidTransform, RigidTransform], Minimum]:
    """Fit X and Z by weighted nonlinear least squares, starting at `start`."""
    # The weights depend on X only through levers, so it is enough to compute them at the start and once more.
    state = start
    by_z = -np.tile(np.eye(6), (len(stack.ta), 1, 1))
    for _ in range(2):
        W = np.linalg.inv(np.linalg.cholesky(noise(stack, state[0], arm)))

        def linearise(poses: tuple[RigidTransform, RigidTransform], W: Array = W) -> tuple[Array, Array]:
            x, z = poses
            e = np.einsum("nij,nj->ni", W, residuals(stack, x, z))
            J = W @ np.concatenate([jacobians(stack, x)[1], by_z], axis=2)
            return e.ravel(), J.reshape(-1, 12)

        state, minimum = descend(
            state, linearise, lambda poses, d: (perturbed(poses[0], d[:6]), perturbed(poses[1], d[6:]))
        )
    return state, minimum


def check_accuracy(covariance: Array, count: int, *, limit_m: float = LIMIT_M, limit_rad: float = LIMIT_RAD) -> None:
    """Check that the covariance of a mount, the first six rows of `covariance`, is within the limits.

    Raises:
        NotObservable: the standard deviation in the worst direction is above a limit; `details["next_axis"]` is the
        axis
            about which to rotate next. `count` is the number of views, for the message.
    """
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    turn = np.linalg.eigvalsh(covariance[3:6, 3:6])
    if np.sqrt(values[2]) <= limit_m and np.sqrt(turn[2]) <= limit_rad:
        return
    weak = vectors[:, 2]
    next_axis = np.cross(weak, np.eye(3)[int(np.argmin(np.abs(weak)))])
    words = np.round(next_axis / np.linalg.norm(next_axis), 2).tolist()
    raise NotObservable(
        f"{count} views leave the camera uncertain by {1e3 * np.sqrt(values[2]):.1f} mm along "
        f"{np.round(weak, 2).tolist()} (flange axes) and by {np.degrees(np.sqrt(turn[2])):.2f} deg",
        hint=f"add views turned by 20 degrees or more about {words} (flange axes), or nearer to the target",
        next_axis=words, sigma_mm=round(1e3 * float(np.sqrt(values[2])), 2),
    )  # fmt: skip


def propose_next(
    done: Sequence[HandEyeView], result: tuple[RigidTransform, RigidTransform], candidates: Sequence[RigidTransform],
    *, view_covariance: Callable[[RigidTransform], Array], arm_sigma_m: float = 1e-4, arm_sigma_rad: float = 1e-4,
) -> tuple[int, float]:  # fmt: skip
    """Choose the next flange pose: the one that reduces the covariance of X most.

    Args:
        done: the stations so far (one or more).
        result: X and Z as far as they are known; nominal values suffice.
        candidates: base_from_flange poses from which the target is in view.
        view_covariance: returns the expected 6x6 covariance of a camera_from_target.

    Returns: index into `candidates`, and the log determinant of X's covariance with that pose (lower is better).

    Raises:
        InvalidRequest: no candidates.
    """
    if not candidates:
        raise InvalidRequest("no candidate poses", hint="give flange poses from which the target is in view")
    x, z = result
    arm = np.diag([arm_sigma_m**2] * 3 + [arm_sigma_rad**2] * 3)

    def information(flange: RigidTransform) -> Array:
        pose = (flange * x).inv() * z
        seen = UncertainPose(parent_from_child=pose, covariance=view_covariance(pose))
        stack = Stations.of([HandEyeView(base_from_flange=flange, camera_from_target=seen)])
        J = np.hstack([jacobians(stack, x)[1][0], -np.eye(6)])
        return np.asarray(J.T @ np.linalg.solve(noise(stack, x, arm)[0], J))

    # A weak prior (0.1 m, 0.3 rad) makes the covariance finite when there are only a few stations.
    known = np.diag([1e2] * 3 + [1e1] * 3 + [1e2] * 3 + [1e1] * 3)
    known = known + sum((information(view.base_from_flange) for view in done), np.zeros((12, 12)))
    scores = []
    for flange in candidates:
        covariance = np.linalg.inv(known + information(flange))
        scores.append(float(np.linalg.slogdet(covariance[:6, :6])[1]))
    best = int(np.argmin(scores))
    return best, scores[best]


def stations(
    base_from_target: RigidTransform, flange_from_camera: RigidTransform, *, distance_m: float, count: int = 40,
    cone_rad: float = 0.7,
) -> list[RigidTransform]:  # fmt: skip
    """Return flange poses from which the camera looks at the target's middle, in a cone about its normal (z).

    They lie on a spiral (golden angle), so that any number of them covers the cone evenly, and have different rolls.
    """
    found = []
    for k in range(count):
        tilt = cone_rad * np.sqrt((k + 0.5) / count)
        azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
        away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        z = -away
        x = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x /= np.linalg.norm(x)
        looking = transform(np.column_stack([x, np.cross(z, x), z]), distance_m * away)
        roll = transform(Rotation.from_rotvec([0.0, 0.0, cone_rad * np.sin(2.4 * k)]).as_matrix(), np.zeros(3))
        found.append(base_from_target * looking * roll * flange_from_camera.inv())
    return found
