"""What a camera on the hand sees of known points, as a model with parameters: residuals, derivatives and noise.

Pixel: u = lens((A X)^-1 Z (p + e)) + s with A = base_from_flange, X = flange_from_camera, Z = base_from_target, errors
e of the points, and an offset s that has two parameters (`InHandState.offset`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import disc_offset_px, project_with_jacobian
from hal.geometry import matrix_of, perturbed, skew
from perception.calibration.intrinsics import NAMES, lens_jacobian, parameters, with_parameters

FREE = ("fx", "fy", "cx", "cy", "k1")  # lens parameters that are estimated
INDEX = [NAMES.index(name) for name in FREE]


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


def priors_of(lens: CameraIntrinsics, known: Beforehand, count: int) -> Array:
    """Return prior standard deviations of lens, point coordinates and offset, in the order of the state's step."""
    of_lens = [
        known.focal_ratio * lens.fx_px,
        known.focal_ratio * lens.fy_px,
        known.centre_px,
        known.centre_px,
        known.k1,
    ]
    return np.array(of_lens + [known.point_m] * (3 * count) + list(known.offset))


def moved(state: InHandState, step: Array) -> InHandState:
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


def residual(view: InHandView, points_m: Array, state: InHandState, disc_m: float) -> tuple[Array, Array]:
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


def noise(view: InHandView, points_m: Array, state: InHandState, known: Beforehand) -> Array:
    """Return the covariance (2N, 2N) of a view's residuals: noise of the pixels, and the common effect of the arm."""
    _, J = residual(view, points_m, state, known.disc_m)
    # A motion of the flange has the effect of the opposite motion of the target, about the flange.
    lever = skew(state.base_from_target.translation - view.base_from_flange.translation)
    by_arm = np.hstack([-J[:, 6:9], J[:, 6:9] @ lever - J[:, 9:12]])
    arm = np.diag([known.arm_m**2] * 3 + [known.arm_rad**2] * 3)
    return np.asarray(by_arm @ arm @ by_arm.T + block_diag(*view.covariance_px))


def chi_square(view: InHandView, points_m: Array, state: InHandState, known: Beforehand) -> float:
    """Return the chi-square of one view."""
    r, _ = residual(view, points_m, state, known.disc_m)
    return float(r @ np.linalg.solve(noise(view, points_m, state, known), r))
