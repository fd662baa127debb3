"""Compiled kinematics of the arm on plain arrays.

`dh`: (n, 4) rows (d, a, alpha, offset) of a standard Denavit-Hartenberg chain, m and rad. Matrices are 4x4 homogeneous.
The tests compare each kernel with a numpy implementation.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put1


@compiled
def frames(dh: Array, q: Array) -> Array:
    """Return the frames of the chain, (n + 1, 4, 4): the base, then one after each joint; the last is the flange."""
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


@compiled
def tool_and_jacobian(dh: Array, q: Array, flange_from_tool: Array) -> tuple[Array, Array]:
    """Return `base_from_tool` (4, 4) and the Jacobian (6, n) of the tool's origin: rows v then omega, base axes."""
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


@inlined
def rotation_exp(w: Array) -> Array:
    """Return the (3, 3) rotation of a rotation vector (3,) rad, by Rodrigues' formula."""
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


@compiled
def rotation_log(r: Array) -> Array:
    """Return the rotation vector (3,) rad of a rotation matrix whose angle is below pi."""
    v = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = 0.5 * np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cosine = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    if sine > 1e-9:
        v *= 0.5 * np.arctan2(sine, cosine) / sine
        return v
    return 0.5 * v


@inlined
def pose_error(goal: Array, pose: Array) -> Array:
    """Return the twist (6,) in base axes that carries `pose` onto `goal`: translation, then rotation vector."""
    out = np.empty(6)
    for k in range(3):
        out[k] = goal[k, 3] - pose[k, 3]
    put1(out[3:], rotation_log(np.ascontiguousarray(goal[:3, :3]) @ np.ascontiguousarray(pose[:3, :3].T)))
    return out


@inlined
def follow_pose(dh: Array, flange_from_tool: Array, q: Array, goal: Array, damping: float, steps: int) -> Array:
    """Return the joints (n,) near `q` whose tool pose is `goal`, by damped least squares.

    dq = J^T (J J^T + damping^2 I)^-1 e. One or two steps are enough, because a control tick moves the goal by less than
    a millimetre.

    Source: Wampler, IEEE SMC 16(1), 1986.
    """
    q = q.copy()
    for _ in range(steps):
        tool, jacobian = tool_and_jacobian(dh, q, flange_from_tool)
        gram = jacobian @ jacobian.T
        for k in range(6):
            gram[k, k] += damping * damping
        q += jacobian.T @ np.linalg.solve(gram, pose_error(goal, tool))
    return q
