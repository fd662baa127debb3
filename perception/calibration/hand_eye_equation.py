"""The hand-eye equation A_i X B_i = Z of several stations at once: residuals, derivatives and noise.

A_i = base_from_flange, X = flange_from_camera, B_i = camera_from_target, Z = base_from_target. Covariances are over
translation, then rotation, in the parent's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.geometry import UncertainPose, matrix_of, skew


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HandEyeView:
    """One station: the flange pose as the arm reports it, and the target's pose as the camera measures it."""

    base_from_flange: RigidTransform
    camera_from_target: UncertainPose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stations:
    """Stations as arrays: rotations (N, 3, 3), translations (N, 3) and covariances (N, 6, 6)."""

    Ra: Array
    ta: Array
    Rb: Array
    tb: Array
    cov_b: Array

    @classmethod
    def of(cls, views: Sequence[HandEyeView]) -> Stations:
        """Collect the arrays of the views."""
        a = [view.base_from_flange for view in views]
        b = [view.camera_from_target.parent_from_child for view in views]
        return cls(
            Ra=np.array([matrix_of(pose) for pose in a]), ta=np.array([pose.translation for pose in a]),
            Rb=np.array([matrix_of(pose) for pose in b]), tb=np.array([pose.translation for pose in b]),
            cov_b=np.array([view.camera_from_target.covariance for view in views]),
        )  # fmt: skip


def residuals(stack: Stations, x: RigidTransform, z: RigidTransform) -> Array:
    """Return the residuals (N, 6): translation and rotation from Z to A X B, base axes."""
    Rx, Rz = matrix_of(x), matrix_of(z)
    shift = np.einsum("nij,nj->ni", stack.Ra, stack.tb @ Rx.T + x.translation) + stack.ta - z.translation
    turn = Rotation.from_matrix(stack.Ra @ Rx @ stack.Rb @ Rz.T).as_rotvec()
    return np.hstack([shift, turn])


def jacobians(stack: Stations, x: RigidTransform) -> tuple[Array, Array, Array]:
    """Return the derivatives (N, 6, 6) of A X B with respect to perturbations of A, of X and of B."""
    Rx = matrix_of(x)
    lever_b = stack.tb @ Rx.T
    lever_x = np.einsum("nij,nj->ni", stack.Ra, x.translation + lever_b)
    by_a, by_x, by_b = (np.zeros((len(lever_b), 6, 6)) for _ in range(3))
    by_a[:, range(6), range(6)] = 1.0
    by_a[:, :3, 3:] = [-skew(lever) for lever in lever_x]
    by_x[:, :3, :3] = by_x[:, 3:, 3:] = stack.Ra
    by_x[:, :3, 3:] = stack.Ra @ np.array([-skew(lever) for lever in lever_b])
    by_b[:, :3, :3] = by_b[:, 3:, 3:] = stack.Ra @ Rx
    return by_a, by_x, by_b


def noise(stack: Stations, x: RigidTransform, arm: Array) -> Array:
    """Return the covariances (N, 6, 6) of the residuals that noise of arm and camera causes."""
    by_a, _, by_b = jacobians(stack, x)
    return np.asarray(by_a @ arm @ by_a.swapaxes(1, 2) + by_b @ stack.cov_b @ by_b.swapaxes(1, 2))


def chi_squares(stack: Stations, x: RigidTransform, z: RigidTransform, arm: Array) -> Array:
    """Return the chi-square (N,) of each station."""
    e = residuals(stack, x, z)
    return np.asarray(np.einsum("ni,ni->n", e, np.linalg.solve(noise(stack, x, arm), e[:, :, None])[:, :, 0]))
