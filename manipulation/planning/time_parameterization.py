"""Converts a joint path to a trajectory within the limits of speed, acceleration and jerk of each joint, and of the tip.

The highest speed along the path within speeds and accelerations is found by a pass backwards and one forwards. Its mean
over a short time turns each step of the acceleration into a ramp. Then the demand of every tick is measured; where
it exceeds a limit, the speed is lowered on that part of the path, and the passes are repeated. In the end time is
stretched by what is left, so that every tick is within the limits.

Source: Pham and Pham, IEEE T-RO 34(3), 2018, for the passes; the mean in time is that of Biagiotti and Melchiorri,
Control Engineering Practice 20(8), 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.motion import Guard, JointTrajectory
from manipulation.arm.kinematics import Kinematics
from manipulation.planning import timing_kernels
from manipulation.planning.smooth_path import SmoothPath

SAMPLE_RAD = 0.01  # spacing of the timing grid along the path
SAMPLES_PER_REACH = 4  # the spacing is smaller where a corner is tight
LEAST_SAMPLES, MOST_SAMPLES = 60, 3000
ROUNDS = 8
GOOD_ENOUGH = 1.003  # a stretch of time that is not worth another round
CURE = 1.6  # power of the excess by which the squared speed is lowered; neighbouring ticks lower the same part again
# The mean is taken over these multiples of the time in which the acceleration may rise to its limit. Twice the time allows
# a change from full acceleration to full deceleration at once; less ends a simple move earlier.
RISES = (1.0, 1.4, 2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedLimits:
    """Speed limits of a transfer: fractions of the joint limits, and the speed of the tool's tip."""

    tip_m_per_s: float
    joint_ratio: float = 0.95
    acceleration_ratio: float = 0.95
    jerk_ratio: float = 0.9  # a last stretch of time by less than a tick may exceed it by a tenth

    def of_joints(self, kinematics: Kinematics) -> Array:
        """Return the largest speed, acceleration and jerk (3, n)."""
        return np.array(
            [
                self.joint_ratio * kinematics.velocity_rad_per_s,
                self.acceleration_ratio * kinematics.acceleration_rad_per_s2,
                self.jerk_ratio * kinematics.jerk_rad_per_s3,
            ]
        )


def timed(
    kinematics: Kinematics,
    path: SmoothPath,
    *,
    flange_from_tool: RigidTransform,
    limits: SpeedLimits,
    name: str,
    guards: tuple[Guard, ...] = (),
) -> JointTrajectory:
    """Return the trajectory along a path from rest to rest."""
    dt_s = 1.0 / kinematics.capabilities.command_rate_hz
    if path.length_rad < 1e-6:
        still = path.points_rad[[0, -1]]
        times = np.array([0.0, dt_s])
        return JointTrajectory(
            name=name, times_s=times, positions_rad=still, velocities_rad_per_s=0.0 * still, guards=guards
        )
    spacing = min(SAMPLE_RAD, float(np.min(path.reaches_rad[1:-1], initial=np.inf)) / SAMPLES_PER_REACH)
    count = int(np.clip(np.ceil(path.length_rad / spacing), LEAST_SAMPLES, MOST_SAMPLES)) + 1
    grid, step = np.linspace(0.0, path.length_rad, count, retstep=True)
    geometry = path.at(grid)
    tool = np.ascontiguousarray(flange_from_tool.as_matrix())
    tip = timing_kernels.tip_ways(kinematics.dh, geometry, tool)
    s, stretch = _fastest(geometry, float(step), tip, limits.of_joints(kinematics), limits.tip_m_per_s, dt_s)
    return _sampled(geometry, float(step), s, dt_s * stretch, name, guards)


def _fastest(
    geometry: Array, step: float, tip: Array, limits: Array, tip_m_per_s: float, dt_s: float
) -> tuple[Array, float]:
    """Return the distances (M,) at the ticks, and by how much the ticks must be stretched to keep all limits."""
    ceiling = _speed_ceiling(geometry, tip, limits, tip_m_per_s) ** 2
    rise_ticks = float(np.max(limits[1] / limits[2])) / dt_s
    found = [
        _smoothed(geometry, step, tip, limits, tip_m_per_s, dt_s, ceiling, max(1, int(np.ceil(rises * rise_ticks))))
        for rises in RISES
    ]
    return min(found, key=lambda one: len(one[0]) * one[1])


def _smoothed(
    geometry: Array, step: float, tip: Array, limits: Array, tip_m_per_s: float, dt_s: float, ceiling: Array, width: int
) -> tuple[Array, float]:
    """Return what `_fastest` returns, for the mean over `width` ticks and a first ceiling (N,) of s'^2."""
    best = np.empty(0), np.inf
    for _ in range(ROUNDS):
        x = timing_kernels.squared_speeds(geometry, step, ceiling, limits[1])
        raw = timing_kernels.distances(x, step, dt_s)
        s = timing_kernels.smoothed(raw, width)
        joints = timing_kernels.joints_at(geometry, step, s)
        excess = timing_kernels.demands(joints, s, step, tip, limits, tip_m_per_s, dt_s)
        stretch = max(1.0, float(excess.max()))
        if len(best[0]) == 0 or len(s) * stretch < len(best[0]) * best[1]:
            best = s, stretch
        if stretch < GOOD_ENOUGH:
            break
        ceiling = timing_kernels.lowered(ceiling, x, raw, excess, width, step, CURE)
    return best


def _speed_ceiling(geometry: Array, tip: Array, limits: Array, tip_m_per_s: float) -> Array:
    """Return the highest ds/dt (N,) by speed, curvature and its change, each taken by itself."""
    tiny = 1e-9
    _, q_s, q_ss, q_sss = np.abs(geometry)
    highest: Array = np.minimum.reduce(
        [
            np.min(limits[0] / (q_s + tiny), axis=1),
            tip_m_per_s / (tip + tiny),
            np.sqrt(np.min(limits[1] / (q_ss + tiny), axis=1)),
            np.cbrt(np.min(limits[2] / (q_sss + tiny), axis=1)),
        ]
    )
    return highest


def _sampled(
    geometry: Array, step: float, s: Array, tick_s: float, name: str, guards: tuple[Guard, ...]
) -> JointTrajectory:
    joints = timing_kernels.joints_at(geometry, step, s)
    times = tick_s * np.arange(len(s), dtype=float)
    # With the velocities of this spline the executor's cubics have a continuous acceleration.
    from scipy.interpolate import CubicSpline  # takes 0.3 s, which the start of a service has not

    velocities = CubicSpline(times, joints, bc_type="clamped")(times, 1)
    return JointTrajectory(
        name=name, times_s=times, positions_rad=joints, velocities_rad_per_s=velocities, guards=guards
    )
