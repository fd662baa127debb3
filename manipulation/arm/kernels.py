"""Compiled inner loops of the arm's kinematics and of the control tick; plain arrays in, plain arrays out.

`dh`: (n, 4) rows (d, a, alpha, offset) of a standard Denavit-Hartenberg chain, m and rad. Matrices are 4x4 homogeneous.
numba with `cache=True`; the tests hold a numpy oracle beside every one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from hal.arrays import Array


@njit(cache=True)
def frames(dh: Array, q: Array) -> Any:
    """Frames of the chain, (n + 1, 4, 4): the base, then the frame after each joint; the last is the flange."""
    n = dh.shape[0]
    out = np.zeros((n + 1, 4, 4))
    for k in range(4):
        out[0, k, k] = 1.0
    link = np.zeros((4, 4))
    link[3, 3] = 1.0
    for i in range(n):
        d, a, alpha = dh[i, 0], dh[i, 1], dh[i, 2]
        c, s = np.cos(q[i] + dh[i, 3]), np.sin(q[i] + dh[i, 3])
        ca, sa = np.cos(alpha), np.sin(alpha)
        link[0, 0], link[0, 1], link[0, 2], link[0, 3] = c, -s * ca, s * sa, a * c
        link[1, 0], link[1, 1], link[1, 2], link[1, 3] = s, c * ca, -c * sa, a * s
        link[2, 1], link[2, 2], link[2, 3] = sa, ca, d
        for r in range(3):
            for k in range(4):
                total = 0.0
                for m in range(4):
                    total += out[i, r, m] * link[m, k]
                out[i + 1, r, k] = total
        out[i + 1, 3, 3] = 1.0
    return out


@njit(cache=True)
def tool_and_jacobian(dh: Array, q: Array, flange_from_tool: Array) -> Any:
    """`base_from_tool` (4, 4) and the Jacobian (6, n) of the tool's origin: rows v then omega, base axes."""
    n = dh.shape[0]
    chain = frames(dh, q)
    tool = np.ascontiguousarray(chain[n]) @ flange_from_tool
    jacobian = np.empty((6, n))
    for i in range(n):
        zx, zy, zz = chain[i, 0, 2], chain[i, 1, 2], chain[i, 2, 2]
        rx, ry, rz = tool[0, 3] - chain[i, 0, 3], tool[1, 3] - chain[i, 1, 3], tool[2, 3] - chain[i, 2, 3]
        jacobian[0, i] = zy * rz - zz * ry
        jacobian[1, i] = zz * rx - zx * rz
        jacobian[2, i] = zx * ry - zy * rx
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = zx, zy, zz
    return tool, jacobian


@njit(cache=True)
def rotation_exp(w: Array) -> Any:
    """Rodrigues: the (3, 3) rotation of a rotation vector (3,) rad."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if angle < 1e-12:
        a, b = 1.0, 0.5
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    x, y, z = w[0], w[1], w[2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return out


@njit(cache=True)
def rotation_log(r: Array) -> Any:
    """The rotation vector (3,) rad of a rotation matrix whose angle is below pi."""
    v = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = 0.5 * np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cosine = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    if sine > 1e-9:
        return v * (0.5 * np.arctan2(sine, cosine) / sine)
    return 0.5 * v


@njit(cache=True)
def pose_error(goal: Array, pose: Array) -> Any:
    """The twist (6,) in base axes that carries `pose` onto `goal`: translation, then rotation vector."""
    out = np.empty(6)
    for k in range(3):
        out[k] = goal[k, 3] - pose[k, 3]
    out[3:] = rotation_log(np.ascontiguousarray(goal[:3, :3]) @ np.ascontiguousarray(pose[:3, :3].T))
    return out


@njit(cache=True)
def pose_on_path(
    times_s: Array, ways: Array, speeds: Array, points: Array, rotations: Array, turns: Array, t_s: float
) -> Any:
    """The pose (4, 4) at `t_s` on a path: points (N, 3), rotations (N, 3, 3), turns (N - 1, 3) from one to the next.

    Straight and with constant turn between neighbours, R(f) = Exp(f w) R_i, as `hal.geometry.interpolate`. The way
    along the path (ways (N,), speeds (N,)) is a cubic Hermite in time, so that the speed has no steps: with constant
    speed between samples 20 ms apart the tool's inertia made 6 N at every start.
    """
    out = np.eye(4)
    last = times_s.shape[0] - 1
    if last == 0 or t_s >= times_s[last]:
        out[:3, :3], out[:3, 3] = rotations[last], points[last]
        return out
    i = min(max(np.searchsorted(times_s, t_s, side="right") - 1, 0), last - 1)
    h = times_s[i + 1] - times_s[i]
    u = min(max((t_s - times_s[i]) / h, 0.0), 1.0)
    length = ways[i + 1] - ways[i]
    f = u
    if length > 0.0:
        rise = u * u * (3.0 - 2.0 * u)
        f = rise + (u * (1.0 - u) ** 2 * speeds[i] + u * u * (u - 1.0) * speeds[i + 1]) * h / length
    out[:3, :3] = rotation_exp(f * turns[i]) @ rotations[i]
    out[:3, 3] = points[i] + f * (points[i + 1] - points[i])
    return out


@njit(cache=True)
def follow_pose(dh: Array, flange_from_tool: Array, q: Array, goal: Array, damping: float, steps: int) -> Any:
    """Joints (n,) near `q` whose tool pose is `goal`: damped least squares, dq = J^T (J J^T + damping^2 I)^-1 e.

    Source: Wampler, IEEE SMC 16(1), 1986. One or two steps do, since a control tick moves the goal by under a
    millimetre.
    """
    q = q.copy()
    for _ in range(steps):
        tool, jacobian = tool_and_jacobian(dh, q, flange_from_tool)
        gram = jacobian @ jacobian.T
        for k in range(6):
            gram[k, k] += damping * damping
        q += jacobian.T @ np.linalg.solve(gram, pose_error(goal, tool))
    return q


@njit(cache=True)
def path_joints(
    dh: Array,
    flange_from_tool: Array,
    times_s: Array,
    ways: Array,
    speeds: Array,
    points: Array,
    rotations: Array,
    turns: Array,
    t_s: float,
    shift: Array,
    offset: Array,
    q: Array,
    damping: float,
) -> Any:
    """Joints (n,) near `q` for the path's pose at `t_s`, moved by `shift` (6,) in base axes and by `offset` (6,) in
    tool axes.
    """
    pose = pose_on_path(times_s, ways, speeds, points, rotations, turns, t_s)
    rotation = rotation_exp(shift[3:]) @ np.ascontiguousarray(pose[:3, :3])
    pose[:3, 3] += shift[:3] + rotation @ offset[:3]
    pose[:3, :3] = rotation @ rotation_exp(offset[3:])
    return follow_pose(dh, flange_from_tool, q, pose, damping, 2)


@njit(cache=True)
def hermite(times_s: Array, positions: Array, velocities: Array, t_s: float) -> Any:
    """The cubic Hermite interpolant (n,) through (N, n) positions and velocities; constant beyond the ends."""
    last = times_s.shape[0] - 1
    if t_s <= times_s[0]:
        return positions[0].copy()
    if t_s >= times_s[last]:
        return positions[last].copy()
    i = np.searchsorted(times_s, t_s, side="right") - 1
    h = times_s[i + 1] - times_s[i]
    u = (t_s - times_s[i]) / h
    h00, h10 = (1.0 + 2.0 * u) * (1.0 - u) ** 2, u * (1.0 - u) ** 2
    h01, h11 = u * u * (3.0 - 2.0 * u), u * u * (u - 1.0)
    return h00 * positions[i] + h10 * h * velocities[i] + h01 * positions[i + 1] + h11 * h * velocities[i + 1]


@njit(cache=True)
def admittance_step(
    state: Array, wrench: Array, stiffness: Array, damping: Array, mass: Array, bound: Array, dt_s: float
) -> None:
    """One semi-implicit Euler step of m a + d v + k x = f per axis, in place; `state`: (2, 6) offset and velocity.

    Damping and spring act implicitly, so that the step is stable for any gain. An axis with infinite stiffness stays
    at 0. Beyond `bound` (6,) the offset stops.
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


@njit(cache=True)
def wrench_at(wrench: Array, child_from_parent: Array) -> Any:
    """A wrench (6,) given in the parent about its origin, seen in the child about the child's origin.

    f' = R f,  t' = R t + p x R f  with child_from_parent = (R, p).
    """
    r, p = np.ascontiguousarray(child_from_parent[:3, :3]), child_from_parent[:3, 3]
    force, torque = r @ wrench[:3], r @ wrench[3:]
    out = np.empty(6)
    out[:3] = force
    out[3] = torque[0] + p[1] * force[2] - p[2] * force[1]
    out[4] = torque[1] + p[2] * force[0] - p[0] * force[2]
    out[5] = torque[2] + p[0] * force[1] - p[1] * force[0]
    return out


@njit(cache=True)
def weight_at(up_m_per_s2: Array, mass_kg: float, centre_m: Array) -> Any:
    """Wrench (6,) of gravity about the sensor: f = -m g up, t = c x f. `up_m_per_s2`: g times "up" in sensor axes."""
    out = np.empty(6)
    for k in range(3):
        out[k] = -mass_kg * up_m_per_s2[k]
    out[3] = centre_m[1] * out[2] - centre_m[2] * out[1]
    out[4] = centre_m[2] * out[0] - centre_m[0] * out[2]
    out[5] = centre_m[0] * out[1] - centre_m[1] * out[0]
    return out


@njit(cache=True)
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
) -> Any:
    """All that a tick looks at: base_from_tool (4, 4), commanded tip (3,), contact wrench (6,) in tool axes.

    contact = raw - bias - weight in sensor axes, carried over to the tool.
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
    """Compile (or load from the cache) every kernel of the control tick, so that no tick waits for a compiler."""
    n, eye = dh.shape[0], np.eye(4)
    q = np.full(n, 0.1)
    times, points, rotations = np.array([0.0, 1.0]), np.zeros((2, 3)), np.array([np.eye(3), np.eye(3)])
    frames(dh, q)
    path_joints(
        dh, eye, times, times, np.zeros(2), points, rotations, np.zeros((1, 3)), 0.5, np.zeros(6), np.zeros(6), q, 1.0
    )
    hermite(times, np.zeros((2, n)), np.zeros((2, n)), 0.5)
    admittance_step(np.zeros((2, 6)), np.zeros(6), np.ones(6), np.ones(6), np.ones(6), np.ones(6), 0.01)
    wrench_at(np.zeros(6), eye)
    tick_view(dh, q, q, eye, eye, eye, np.zeros(6), np.zeros(6), 1.0, np.zeros(3), 9.8)
