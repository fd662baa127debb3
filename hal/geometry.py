"""Rigid motions with covariance.

Poses are `scipy.spatial.transform.RigidTransform`, named `parent_from_child`, so that
`base_from_flange * flange_from_camera` reads without a diagram.

A 6x6 covariance is over `(dx, dy, dz, rx, ry, rz)`, metres and radians, in the axes of the parent frame: the true pose
has translation `t + d` and rotation `Exp(r) R`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array


def skew(v: ArrayLike) -> Array:
    """The matrix of the cross product: `skew(a) @ b == cross(a, b)`. `v`: (3,)."""
    x, y, z = np.asarray(v, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(matrix: ArrayLike, translation_m: ArrayLike) -> RigidTransform:
    """A rigid motion from a 3x3 rotation matrix and a translation in metres."""
    return RigidTransform.from_components(np.asarray(translation_m, float), Rotation.from_matrix(matrix))


def transform_rpy(translation_m: ArrayLike, roll_pitch_yaw_rad: ArrayLike) -> RigidTransform:
    """A rigid motion from a translation and fixed-axis roll, pitch and yaw (x, then y, then z of the parent)."""
    return RigidTransform.from_components(
        np.asarray(translation_m, float), Rotation.from_euler("xyz", np.asarray(roll_pitch_yaw_rad, float))
    )


def identity() -> RigidTransform:
    """The motion that changes nothing."""
    return RigidTransform.identity()


def matrix_of(pose: RigidTransform) -> Array:
    """(3, 3) rotation matrix of a pose."""
    return np.asarray(pose.rotation.as_matrix(), float)


def perturbed(pose: RigidTransform, delta: ArrayLike) -> RigidTransform:
    """The pose with translation `t + d` and rotation `Exp(r) R` for `delta = (d, r)`, (6,), m and rad."""
    delta = np.asarray(delta, float)
    return RigidTransform.from_components(pose.translation + delta[:3], Rotation.from_rotvec(delta[3:]) * pose.rotation)


def difference(true: RigidTransform, estimate: RigidTransform) -> Array:
    """The `delta` with `true == perturbed(estimate, delta)`, (6,), m and rad."""
    rotation = (true.rotation * estimate.rotation.inv()).as_rotvec()
    return np.concatenate([true.translation - estimate.translation, rotation])


def interpolate(start: RigidTransform, end: RigidTransform, fraction: float) -> RigidTransform:
    """The pose `fraction` of the way: straight in translation, constant turn in rotation."""
    return perturbed(start, fraction * difference(end, start))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UncertainPose:
    """A pose with a 6x6 covariance in the convention of this module."""

    parent_from_child: RigidTransform
    covariance: Array

    def __post_init__(self) -> None:
        if self.covariance.shape != (6, 6):
            raise ValueError(f"covariance must be 6x6, not {self.covariance.shape}")

    def __mul__(self, other: UncertainPose) -> UncertainPose:
        """Chain of two independent uncertain poses."""
        return compose(self, other)

    def inverse(self) -> UncertainPose:
        """`child_from_parent` with its covariance."""
        R = matrix_of(self.parent_from_child)
        t = self.parent_from_child.translation
        # t' = -R^T t:  d' = -R^T (d - r x t) = -R^T d - R^T [t]x r;   r' = -R^T r
        J = np.block([[-R.T, -R.T @ skew(t)], [np.zeros((3, 3)), -R.T]])
        return UncertainPose(parent_from_child=self.parent_from_child.inv(), covariance=J @ self.covariance @ J.T)


def compose(a_from_b: UncertainPose, b_from_c: UncertainPose) -> UncertainPose:
    """`a_from_c` with first-order covariance; the two are independent."""
    Ra = matrix_of(a_from_b.parent_from_child)
    lever = Ra @ b_from_c.parent_from_child.translation
    Ja = np.block([[np.eye(3), -skew(lever)], [np.zeros((3, 3)), np.eye(3)]])
    Jb = np.block([[Ra, np.zeros((3, 3))], [np.zeros((3, 3)), Ra]])
    covariance = Ja @ a_from_b.covariance @ Ja.T + Jb @ b_from_c.covariance @ Jb.T
    return UncertainPose(
        parent_from_child=a_from_b.parent_from_child * b_from_c.parent_from_child, covariance=covariance
    )


def certain(parent_from_child: RigidTransform) -> UncertainPose:
    """A pose known exactly."""
    return UncertainPose(parent_from_child=parent_from_child, covariance=np.zeros((6, 6)))


def point_covariance(parent_from_child: UncertainPose, point_m: ArrayLike) -> Array:
    """(3, 3) covariance in the parent of a point fixed in the child, (3,) m."""
    lever = matrix_of(parent_from_child.parent_from_child) @ np.asarray(point_m, float)
    J = np.hstack([np.eye(3), -skew(lever)])
    return np.asarray(J @ parent_from_child.covariance @ J.T)


def to_json(pose: RigidTransform) -> dict[str, Any]:
    """`translation_m` (x, y, z) and `quaternion_xyzw`, plain lists."""
    return {
        "translation_m": [float(v) for v in pose.translation],
        "quaternion_xyzw": [float(v) for v in pose.rotation.as_quat(canonical=True)],
    }


def from_json(value: dict[str, Any]) -> RigidTransform:
    """The inverse of `to_json`."""
    return RigidTransform.from_components(value["translation_m"], Rotation.from_quat(value["quaternion_xyzw"]))
