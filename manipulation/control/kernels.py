"""Compiled inner loops of the control tick: the joints that a motion wants, and what the tool measures.

Arrays are as in `manipulation.arm.kernels`; the tests compare each kernel with a numpy implementation.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put1, put2
from manipulation.arm.kernels import follow_pose, frames, rotation_exp


@inlined
def pose_on_path(
    times_s: Array, ways: Array, speeds: Array, points: Array, rates: Array, rotations: Array, turns: Array, t_s: float
) -> Array:
    """Return the pose (4, 4) at `t_s` on a path of points (N, 3), rotations (N, 3, 3) and turns (N - 1, 3).

    Between neighbours the tool turns about one axis w, R(f) = Exp(f w) R_i, as in `hal.geometry.interpolate`. The
    distance along the path (ways (N,), speeds (N,)) is a cubic Hermite polynomial in time, and so is the point, with the
    velocities `rates` (2, N - 1, 3) at the begin and the end of each leg. A constant speed between samples 20 ms apart
    causes 6 N of tool inertia at every start.
    """
    out = np.eye(4)
    last = times_s.shape[0] - 1
    if last == 0 or t_s >= times_s[last]:
        put2(out, rotations[last])
        put1(out[:3, 3], points[last])
        return out
    i = min(max(np.searchsorted(times_s, t_s, side="right") - 1, 0), last - 1)
    h = times_s[i + 1] - times_s[i]
    u = min(max((t_s - times_s[i]) / h, 0.0), 1.0)
    length = ways[i + 1] - ways[i]
    f = u
    rise, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) ** 2 * h, u * u * (u - 1.0) * h
    if length > 0.0:
        f = rise + (begin * speeds[i] + end * speeds[i + 1]) / length
    put2(out, rotation_exp(f * turns[i]) @ rotations[i])
    for k in range(3):
        way = rise * (points[i + 1, k] - points[i, k])
        out[k, 3] = points[i, k] + way + begin * rates[0, i, k] + end * rates[1, i, k]
    return out


@compiled
def path_joints(
    dh: Array,
    flange_from_tool: Array,
    times_s: Array,
    ways: Array,
    speeds: Array,
    points: Array,
    rates: Array,
    rotations: Array,
    turns: Array,
    t_s: float,
    shift: Array,
    offset: Array,
    q: Array,
    damping: float,
) -> Array:
    """Return the joints (n,) near `q` for the path's pose at `t_s`, displaced by `shift` and `offset`.

    `shift` (6,) is in base axes, `offset` (6,) in tool axes; translation first, then rotation vector.
    """
    pose = pose_on_path(times_s, ways, speeds, points, rates, rotations, turns, t_s)
    rotation = rotation_exp(shift[3:]) @ np.ascontiguousarray(pose[:3, :3])
    moved = rotation @ offset[:3]
    for k in range(3):
        pose[k, 3] += shift[k] + moved[k]
    put2(pose, rotation @ rotation_exp(offset[3:]))
    return follow_pose(dh, flange_from_tool, q, pose, damping, 2)


@compiled
def path_demand(
    dh: Array,
    flange_from_tool: Array,
    times_s: Array,
    ways: Array,
    speeds: Array,
    points: Array,
    rates: Array,
    rotations: Array,
    turns: Array,
    q: Array,
    damping: float,
    step_s: float,
) -> Array:
    """Return the largest speed and acceleration (2, n) of the joints along a path, by differences over `step_s`."""
    n = dh.shape[0]
    out = np.zeros((2, n))
    here = follow_pose(
        dh, flange_from_tool, q, pose_on_path(times_s, ways, speeds, points, rates, rotations, turns, 0.0), damping, 3
    )
    velocity = np.zeros(n)
    count = int(np.ceil(times_s[times_s.shape[0] - 1] / step_s))
    for k in range(1, count + 1):
        pose = pose_on_path(times_s, ways, speeds, points, rates, rotations, turns, k * step_s)
        there = follow_pose(dh, flange_from_tool, here, pose, damping, 2)
        for i in range(n):
            v = (there[i] - here[i]) / step_s
            out[0, i] = max(out[0, i], abs(v))
            out[1, i] = max(out[1, i], abs(v - velocity[i]) / step_s)
            velocity[i] = v
        here = there
    return out


@compiled
def hermite(times_s: Array, positions: Array, velocities: Array, t_s: float) -> Array:
    """Return the cubic Hermite interpolant (n,) through (N, n) positions and velocities; constant beyond the ends."""
    last = times_s.shape[0] - 1
    if t_s <= times_s[0]:
        return np.copy(positions[0])
    if t_s >= times_s[last]:
        return np.copy(positions[last])
    i = np.searchsorted(times_s, t_s, side="right") - 1
    h = times_s[i + 1] - times_s[i]
    u = (t_s - times_s[i]) / h
    h00, h10 = (1.0 + 2.0 * u) * (1.0 - u) ** 2, u * (1.0 - u) ** 2
    h01, h11 = u * u * (3.0 - 2.0 * u), u * u * (u - 1.0)
    out: Array = h00 * positions[i] + h10 * h * velocities[i] + h01 * positions[i + 1] + h11 * h * velocities[i + 1]
    return out


@compiled
def admittance_step(
    state: Array, wrench: Array, stiffness: Array, damping: Array, mass: Array, bound: Array, dt_s: float
) -> None:
    """Make one semi-implicit Euler step of m a + d v + k x = f per axis, in place; `state` (2, 6): offset, velocity.

    Damping and spring act implicitly, so that the step is stable for any gain. An axis with infinite stiffness stays
    at 0. The offset stops at `bound` (6,).
    """
    for k in range(6):
        if np.isinf(stiffness[k]):
            continue
        x, v = state[0, k], state[1, k]
        v = (mass[k] * v + dt_s * (wrench[k] - stiffness[k] * x)) / (
            mass[k] + dt_s * damping[k] + dt_s * dt_s * stiffness[k]
        )
        x += dt_s * v
        if abs(x) > bound[k]:
            x = bound[k] if x > 0.0 else -bound[k]
            v = 0.0
        state[0, k], state[1, k] = x, v


@inlined
def wrench_at(wrench: Array, child_from_parent: Array) -> Array:
    """Return a wrench (6,), given in the parent about its origin, in child axes about the child's origin.

    f' = R f,  t' = R t + p x R f  with child_from_parent = (R, p).
    """
    r, p = np.ascontiguousarray(child_from_parent[:3, :3]), child_from_parent[:3, 3]
    force, torque = r @ wrench[:3], r @ wrench[3:]
    out = np.empty(6)
    put1(out, force)
    out[3] = torque[0] + p[1] * force[2] - p[2] * force[1]
    out[4] = torque[1] + p[2] * force[0] - p[0] * force[2]
    out[5] = torque[2] + p[0] * force[1] - p[1] * force[0]
    return out


@inlined
def weight_at(up_m_per_s2: Array, mass_kg: float, centre_m: Array) -> Array:
    """Return the wrench (6,) of gravity about the sensor: f = -m g up, t = c x f.

    `up_m_per_s2` (3,) is g times the upward unit vector in sensor axes.
    """
    out = np.empty(6)
    for k in range(3):
        out[k] = -mass_kg * up_m_per_s2[k]
    out[3] = centre_m[1] * out[2] - centre_m[2] * out[1]
    out[4] = centre_m[2] * out[0] - centre_m[0] * out[2]
    out[5] = centre_m[0] * out[1] - centre_m[1] * out[0]
    return out


@compiled
def tick_view(
    dh: Array,
    q: Array,
    commanded: Array,
    flange_from_tool: Array,
    flange_from_sensor: Array,
    tool_from_sensor: Array,
    raw: Array,
    bias: Array,
    mass_kg: float,
    centre_m: Array,
    gravity_m_per_s2: float,
) -> tuple[Array, Array, Array]:
    """Return all that a tick needs: base_from_tool (4, 4), commanded tip (3,), contact wrench (6,) in tool axes.

    The contact wrench is raw - bias - weight in sensor axes, transformed to the tool.
    """
    n = dh.shape[0]
    flange = np.ascontiguousarray(frames(dh, q)[n])
    tool = flange @ flange_from_tool
    aimed = np.ascontiguousarray(frames(dh, commanded)[n])
    tip = np.empty(3)
    for k in range(3):
        tip[k] = aimed[k, 3]
        for m in range(3):
            tip[k] += aimed[k, m] * flange_from_tool[m, 3]
    up = np.zeros(3)
    for k in range(3):
        for m in range(3):
            up[k] += flange[2, m] * flange_from_sensor[m, k]
        up[k] *= gravity_m_per_s2
    contact = raw - bias - weight_at(up, mass_kg, centre_m)
    return tool, tip, wrench_at(contact, tool_from_sensor)


def warm(dh: Array) -> None:
    """Compile every kernel of the control tick (or load it from the cache), so that no tick waits for a compiler."""
    n, eye = dh.shape[0], np.eye(4)
    q = np.full(n, 0.1)
    times, points, rotations = np.array([0.0, 1.0]), np.zeros((2, 3)), np.array([np.eye(3), np.eye(3)])
    frames(dh, q)
    path_joints(
        dh,
        eye,
        times,
        times,
        np.zeros(2),
        points,
        np.zeros((2, 1, 3)),
        rotations,
        np.zeros((1, 3)),
        0.5,
        np.zeros(6),
        np.zeros(6),
        q,
        1.0,
    )
    path_demand(
        dh, eye, times, times, np.zeros(2), points, np.zeros((2, 1, 3)), rotations, np.zeros((1, 3)), q, 1.0, 0.5
    )
    hermite(times, np.zeros((2, n)), np.zeros((2, n)), 0.5)
    admittance_step(np.zeros((2, 6)), np.zeros(6), np.ones(6), np.ones(6), np.ones(6), np.ones(6), 0.01)
    wrench_at(np.zeros(6), eye)
    tick_view(dh, q, q, eye, eye, eye, np.zeros(6), np.zeros(6), 1.0, np.zeros(3), 9.8)
