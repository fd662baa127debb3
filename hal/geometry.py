"""Rigid transforms with covariance.

Poses are `scipy.spatial.transform.RigidTransform`, named `parent_from_child`, so that
`base_from_flange * flange_from_camera` reads without a diagram.

A 6x6 covariance is over `(dx, dy, dz, rx, ry, rz)`, metres and radians, in the axes of the parent frame: the true pose
has translation `t + d` and rotation `Exp(r) R`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array


def skew(v: ArrayLike) -> Array:
    """Return the (3, 3) matrix of the cross product with `v`, (3,): `skew(a) @ b == cross(a, b)`."""
    x, y, z = np.asarray(v, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(matrix: ArrayLike, translation_m: ArrayLike) -> RigidTransform:
    """Return a rigid transform from a 3x3 rotation matrix and a translation in metres."""
    return RigidTransform.from_components(np.asarray(translation_m, float), Rotation.from_matrix(matrix))


def transform_rpy(translation_m: ArrayLike, roll_pitch_yaw_rad: ArrayLike) -> RigidTransform:
    """Return a rigid transform from a translation and fixed-axis roll, pitch, yaw (x, then y, then z of the parent)."""
    roll_rad, pitch_rad, yaw_rad = (float(x) for x in np.asarray(roll_pitch_yaw_rad, float))
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(x), math.sin(x)) for x in (roll_rad, pitch_rad, yaw_rad))
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    matrix[:3, 3] = translation_m
    return orthonormal(matrix)


def orthonormal(matrix: Array) -> RigidTransform:
    """Return the transform of a (4, 4) matrix whose rotation is orthonormal already, such as that of forward kinematics.

    Nothing checks or normalises it, which takes a sixth of the time of `RigidTransform.from_matrix`.
    """
    return RigidTransform(matrix, normalize=False, copy=True)


def product(a_from_b: RigidTransform, b_from_c: RigidTransform) -> RigidTransform:
    """Return `a_from_b * b_from_c` without normalising it again, which takes a quarter of the time."""
    return orthonormal(a_from_b.as_matrix() @ b_from_c.as_matrix())


def identity() -> RigidTransform:
    """Return the identity transform."""
    return RigidTransform.identity()


def matrix_of(pose: RigidTransform) -> Array:
    """Return the (3, 3) rotation matrix of a pose."""
    return np.ascontiguousarray(pose.as_matrix()[:3, :3])


def perturbed(pose: RigidTransform, delta: ArrayLike) -> RigidTransform:
    """Return the pose with translation `t + d` and rotation `Exp(r) R` for `delta = (d, r)`, (6,), m and rad."""
    delta = np.asarray(delta, float)
    return RigidTransform.from_components(pose.translation + delta[:3], Rotation.from_rotvec(delta[3:]) * pose.rotation)


def difference(true: RigidTransform, estimate: RigidTransform) -> Array:
    """Return the `delta` for which `true == perturbed(estimate, delta)`, (6,), m and rad."""
    rotation = (true.rotation * estimate.rotation.inv()).as_rotvec()
    return np.concatenate([true.translation - estimate.translation, rotation])


def interpolate(start: RigidTransform, end: RigidTransform, fraction: float) -> RigidTransform:
    """Return the pose at `fraction` of the way: linear in translation, about one fixed axis in rotation."""
    return perturbed(start, fraction * difference(end, start))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UncertainPose:
    """Pose with a 6x6 covariance in the convention of this module."""

    parent_from_child: RigidTransform
    covariance: Array

    def __post_init__(self) -> None:
        if self.covariance.shape != (6, 6):
            raise ValueError(f"covariance must be 6x6, not {self.covariance.shape}")

    def __mul__(self, other: UncertainPose) -> UncertainPose:
        """Return the composition of two independent uncertain poses."""
        return compose(self, other)

    def inverse(self) -> UncertainPose:
        """Return `child_from_parent` with its covariance."""
        R = matrix_of(self.parent_from_child)
        t = self.parent_from_child.translation
        # t' = -R^T t:  d' = -R^T (d - r x t) = -R^T d - R^T [t]x r;   r' = -R^T r
        J = np.block([[-R.T, -R.T @ skew(t)], [np.zeros((3, 3)), -R.T]])
        return UncertainPose(parent_from_child=self.parent_from_child.inv(), covariance=J @ self.covariance @ J.T)


def compose(a_from_b: UncertainPose, b_from_c: UncertainPose) -> UncertainPose:
    """Return `a_from_c` with its covariance to first order, for independent poses."""
    Ra = matrix_of(a_from_b.parent_from_child)
    lever = Ra @ b_from_c.parent_from_child.translation
    Ja = np.block([[np.eye(3), -skew(lever)], [np.zeros((3, 3)), np.eye(3)]])
    Jb = np.block([[Ra, np.zeros((3, 3))], [np.zeros((3, 3)), Ra]])
    covariance = Ja @ a_from_b.covariance @ Ja.T + Jb @ b_from_c.covariance @ Jb.T
    return UncertainPose(
        parent_from_child=a_from_b.parent_from_child * b_from_c.parent_from_child, covariance=covariance
    )


def certain(parent_from_child: RigidTransform) -> UncertainPose:
    """Return a pose that is known exactly, with zero covariance."""
    return UncertainPose(parent_from_child=parent_from_child, covariance=np.zeros((6, 6)))


def point_covariance(parent_from_child: UncertainPose, point_m: ArrayLike) -> Array:
    """Return the (3, 3) covariance, in the parent frame, of a point that is fixed in the child frame, (3,) m."""
    lever = matrix_of(parent_from_child.parent_from_child) @ np.asarray(point_m, float)
    J = np.hstack([np.eye(3), -skew(lever)])
    return np.asarray(J @ parent_from_child.covariance @ J.T)


def to_json(pose: RigidTransform) -> dict[str, Any]:
    """Return the pose as plain lists: `translation_m` (x, y, z) and `quaternion_xyzw`."""
    return {
        "translation_m": [float(v) for v in pose.translation],
        "quaternion_xyzw": [float(v) for v in pose.rotation.as_quat(canonical=True)],
    }


def from_json(value: dict[str, Any]) -> RigidTransform:
    """Return the pose of which `to_json` made `value`."""
    return RigidTransform.from_components(value["translation_m"], Rotation.from_quat(value["quaternion_xyzw"]))
