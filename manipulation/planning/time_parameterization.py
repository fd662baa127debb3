"""Converts a joint path to a trajectory within the limits of joints and tip.

The path q(s) is sampled on a grid with rounded corners. Then the speed ds/dt is made as high as the limits allow by one
pass forwards and one backwards over the samples.

Source: Bobrow, Dubowsky and Gibson, IJRR 4(3), 1985, in the grid form of Pham and Pham, IEEE T-RO 34(3), 2018, with the
acceleration limit split in half between the two terms of q'' = q_s s'' + q_ss s'^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.motion import Guard, JointTrajectory
from manipulation.arm import kernels
from manipulation.arm.kinematics import Kinematics

SAMPLE_RAD = 0.02  # spacing of the timing grid along the path


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedLimits:
    """Speed limits of a transfer: fractions of the joint limits, and the speed of the tool's tip."""

    tip_m_per_s: float
    joint_ratio: float = 0.5
    acceleration_ratio: float = 0.5


def timed(
    kinematics: Kinematics,
    path_rad: Array,
    *,
    flange_from_tool: RigidTransform,
    limits: SpeedLimits,
    name: str,
    guards: tuple[Guard, ...] = (),
) -> JointTrajectory:
    """Return the trajectory along a smooth dense path (N, n), N >= 2, from rest to rest."""
    s = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(path_rad, axis=0), axis=1), 1e-9))])
    spline = CubicSpline(s, path_rad) if len(s) > 2 else CubicSpline(s, path_rad, bc_type="clamped")
    if len(s) == 2:
        spline = _line(s, path_rad)
    grid = np.linspace(0.0, s[-1], max(12, int(np.ceil(s[-1] / SAMPLE_RAD)) + 1))
    q, q_s, q_ss = spline(grid), spline(grid, 1), spline(grid, 2)
    speed = _speed_profile(kinematics, grid, q, q_s, q_ss, flange_from_tool, limits)
    mean = 0.5 * (speed[1:] + speed[:-1])
    times = np.concatenate([[0.0], np.cumsum(np.diff(grid) / np.maximum(mean, 1e-6))])
    return JointTrajectory(
        name=name, times_s=times, positions_rad=q, velocities_rad_per_s=q_s * speed[:, None], guards=guards
    )


def _line(s: Array, path: Array) -> CubicSpline:
    middle = 0.5 * (path[0] + path[1])
    return CubicSpline([s[0], 0.5 * (s[0] + s[1]), s[1]], [path[0], middle, path[1]])


def _speed_profile(
    kinematics: Kinematics,
    grid: Array,
    q: Array,
    q_s: Array,
    q_ss: Array,
    flange_from_tool: RigidTransform,
    limits: SpeedLimits,
) -> Array:
    """Return the highest ds/dt (N,) on the grid, zero at both ends."""
    v_max = limits.joint_ratio * kinematics.velocity_rad_per_s
    a_max = 0.5 * limits.acceleration_ratio * kinematics.acceleration_rad_per_s2
    tool = np.ascontiguousarray(flange_from_tool.as_matrix())
    tip = np.array(
        [
            np.linalg.norm(kernels.tool_and_jacobian(kinematics.dh, qi, tool)[1][:3] @ di)
            for qi, di in zip(q, q_s, strict=True)
        ]
    )
    tiny = 1e-9
    ceiling = np.minimum.reduce(
        [
            np.min(v_max / (np.abs(q_s) + tiny), axis=1),
            limits.tip_m_per_s / (tip + tiny),
            np.sqrt(np.min(a_max / (np.abs(q_ss) + tiny), axis=1)),
        ]
    )
    push = np.min(a_max / (np.abs(q_s) + tiny), axis=1)  # (N,) highest s''
    speed = ceiling.copy()
    speed[0] = speed[-1] = 0.0
    step = np.diff(grid)
    for k in range(len(step)):
        speed[k + 1] = min(speed[k + 1], np.sqrt(speed[k] ** 2 + 2.0 * push[k] * step[k]))
    for k in range(len(step) - 1, -1, -1):
        speed[k] = min(speed[k], np.sqrt(speed[k + 1] ** 2 + 2.0 * push[k + 1] * step[k]))
    return np.asarray(speed)
