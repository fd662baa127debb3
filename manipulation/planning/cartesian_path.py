"""Cartesian paths: lines, arcs and sequences of poses, each from rest to rest with ramped speed.

A step of the speed causes more than 8 N of tool inertia at 60 mm/s, which looks like contact. Therefore every path
begins and ends with a ramp, and the acceleration of a ramp rises and falls within a short time. The executor slows a path
that asks for more than the joints may do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation, RotationSpline

from hal.arrays import Array
from hal.geometry import difference, interpolate
from hal.motion import CartesianPath, Compliance, Guard
from manipulation.planning import timing_kernels

RAMP_M_PER_S2 = 0.6  # a 0.9 kg tool pushes 0.5 N at this acceleration, far below any contact threshold
RISE_S = 0.04  # in which the acceleration rises to that
TURN_ARM_M = 0.10  # a turn of 1 rad counts as this much distance when a path is timed
SAMPLE_S, FINE_S = 0.01, 0.002
LEAST_SPLINE = 4  # poses; fewer are joined by straight lines


def line(
    start: RigidTransform,
    end: RigidTransform,
    *,
    name: str,
    speed_m_per_s: float,
    flange_from_tool: RigidTransform,
    guards: tuple[Guard, ...] = (),
    compliance: Compliance | None = None,
    ramp_m_per_s2: float = RAMP_M_PER_S2,
) -> CartesianPath:
    """Return a straight move with constant turn between two tool poses in the base frame."""
    way = _way(start, end)
    moved = difference(end, start)

    def pose_at(s: Array) -> RigidTransform:
        share = (s / way if way > 0 else np.ones_like(s))[:, None]
        turns = Rotation.from_rotvec(share * moved[3:])
        return RigidTransform.from_components(start.translation + share * moved[:3], turns * start.rotation)

    return along(
        pose_at,
        way,
        name=name,
        speed_m_per_s=speed_m_per_s,
        flange_from_tool=flange_from_tool,
        guards=guards,
        compliance=compliance,
        ramp_m_per_s2=ramp_m_per_s2,
    )


def through(
    poses: Sequence[RigidTransform],
    *,
    name: str,
    speed_m_per_s: float,
    flange_from_tool: RigidTransform,
    guards: tuple[Guard, ...] = (),
    compliance: Compliance | None = None,
    slow_last_m: float = 0.0,
    slow_ratio: float = 0.3,
) -> CartesianPath:
    """Return a path through closely spaced poses; over the last `slow_last_m` the speed is `slow_ratio` of the rest.

    Splines join them, because a change of direction at a pose is a step of the velocity.
    """
    ways = [_way(a, b) for a, b in itertools.pairwise(poses)]
    kept = [poses[0], *(pose for pose, way in zip(poses[1:], ways, strict=True) if way > 0.0)]
    marks = np.concatenate([[0.0], np.cumsum([way for way in ways if way > 0.0])])
    if len(kept) < LEAST_SPLINE:
        kept, marks = _with_poses_between(kept, marks)
    if len(kept) < LEAST_SPLINE:  # nothing moves
        kept, marks = [poses[0]] * LEAST_SPLINE, 1e-9 * np.arange(float(LEAST_SPLINE))
    from scipy.interpolate import CubicSpline  # see time_parameterization

    places = CubicSpline(marks, [pose.translation for pose in kept])
    turns = RotationSpline(marks, Rotation.concatenate([pose.rotation for pose in kept]))

    def pose_at(s: Array) -> RigidTransform:
        return RigidTransform.from_components(places(s), turns(s))

    return along(
        pose_at,
        float(marks[-1]),
        name=name,
        speed_m_per_s=speed_m_per_s,
        flange_from_tool=flange_from_tool,
        guards=guards,
        compliance=compliance,
        slow_last_m=slow_last_m,
        slow_ratio=slow_ratio,
    )


def along(
    pose_at: Callable[[Array], RigidTransform],
    way_m: float,
    *,
    name: str,
    speed_m_per_s: float,
    flange_from_tool: RigidTransform,
    guards: tuple[Guard, ...] = (),
    compliance: Compliance | None = None,
    ramp_m_per_s2: float = RAMP_M_PER_S2,
    slow_last_m: float = 0.0,
    slow_ratio: float = 0.3,
) -> CartesianPath:
    """Sample `pose_at(s)`, for s (N,) from 0 to `way_m`, in time with a ramped speed."""
    times, places = ramped(
        way_m, speed_m_per_s, ramp_m_per_s2=ramp_m_per_s2, slow_last_m=slow_last_m, slow_ratio=slow_ratio
    )
    return CartesianPath(
        name=name,
        flange_from_tool=flange_from_tool,
        times_s=times,
        base_from_tool=tuple(pose_at(places)),
        guards=guards,
        compliance=compliance,
    )


def ramped(
    way_m: float,
    speed_m_per_s: float,
    *,
    ramp_m_per_s2: float = RAMP_M_PER_S2,
    slow_last_m: float = 0.0,
    slow_ratio: float = 0.3,
) -> tuple[Array, Array]:
    """Return times (N,) s and distances (N,) m of a move from rest to rest: ramp, cruise, an optional slow end, ramp.

    v(s) = min(v_max, sqrt(2 a s), sqrt(2 a (way - s))), and near the slow part sqrt(v_slow^2 + 2 a (s_slow - s)). The
    distances are means over `RISE_S`, which turn the steps of the acceleration into ramps.
    """
    if way_m <= 0.0:
        return np.array([0.0, SAMPLE_S]), np.array([0.0, 0.0])
    s = way_m * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, 401)))  # dense at both ends, where the speed changes
    v = np.minimum(speed_m_per_s, np.sqrt(2.0 * ramp_m_per_s2 * np.minimum(s, way_m - s)))
    if slow_last_m > 0.0:
        to_slow = np.maximum(0.0, way_m - slow_last_m - s)
        v = np.minimum(v, np.sqrt((slow_ratio * speed_m_per_s) ** 2 + 2.0 * ramp_m_per_s2 * to_slow))
    # Between samples the speed changes evenly with time: dt = 2 ds / (v0 + v1).
    t = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(s) / np.maximum(v[1:] + v[:-1], 1e-9))])
    from scipy.interpolate import CubicHermiteSpline  # see time_parameterization

    way = CubicHermiteSpline(t, s, v)
    fine = np.arange(0.0, t[-1] + FINE_S, FINE_S)
    smooth: Array = timing_kernels.smoothed(way(np.minimum(fine, t[-1])), round(RISE_S / FINE_S))
    duration_s = FINE_S * (len(smooth) - 1)
    times = np.linspace(0.0, duration_s, max(3, int(np.ceil(duration_s / SAMPLE_S)) + 1))
    places = np.interp(times, FINE_S * np.arange(len(smooth)), smooth)
    return times, np.maximum.accumulate(np.clip(places, 0.0, way_m))


def arc(
    start: RigidTransform, *, centre_m: ArrayLike, axis: ArrayLike, angle_rad: float, step_rad: float = 0.03
) -> tuple[RigidTransform, ...]:
    """Return the poses of `start` turned rigidly about a line in the base frame, in even steps; both ends included."""
    centre = np.asarray(centre_m, float)
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    count = max(2, int(np.ceil(abs(angle_rad) / step_rad)) + 1)
    return tuple(turned_about(start, centre, unit, float(a)) for a in np.linspace(0.0, angle_rad, count))


def turned_about(pose: RigidTransform, centre_m: Array, unit_axis: Array, angle_rad: float) -> RigidTransform:
    """Return the pose turned by `angle_rad` about the line through `centre_m`, all in the base frame."""
    turn = Rotation.from_rotvec(angle_rad * unit_axis)
    return RigidTransform.from_components(centre_m + turn.apply(pose.translation - centre_m), turn * pose.rotation)


def shifted(pose: RigidTransform, offset_m: ArrayLike) -> RigidTransform:
    """Return the pose moved by an offset given in its own axes."""
    return pose * RigidTransform.from_translation(np.asarray(offset_m, float))


def _with_poses_between(poses: list[RigidTransform], marks: Array) -> tuple[list[RigidTransform], Array]:
    """Return the poses and marks with two more on each leg."""
    out, at = poses[:1], [float(marks[0])]
    for (a, b), (low, high) in zip(itertools.pairwise(poses), itertools.pairwise(marks), strict=True):
        for share in (1.0 / 3.0, 2.0 / 3.0, 1.0):
            out.append(interpolate(a, b, share))
            at.append(float(low + share * (high - low)))
    return out, np.array(at)


def _way(start: RigidTransform, end: RigidTransform) -> float:
    moved = difference(end, start)
    return float(max(np.linalg.norm(moved[:3]), TURN_ARM_M * np.linalg.norm(moved[3:])))
