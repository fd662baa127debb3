"""Compiled steps of the inverse kinematics: exact branches, whole turns, and the joints along a path of poses.

Arrays are as in `manipulation.arm.kernels`; angles in rad.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from manipulation.arm.kernels import follow_pose, frames, pose_error, tool_and_jacobian

TURN_RAD = 2.0 * np.pi
EXACT = 1e-12  # largest difference of two matrices that needs no improvement
RESIDUAL = 1e-10  # largest difference after it; the solver answers an unreachable pose by least squares
NEAR = 1e-3  # a larger difference is no rounding error of the solver
SAME_RAD = 1e-7  # nearer solutions are one: at a singularity two branches meet
NEWTON_STEPS = 4
FOLLOW_STEPS = 12  # per pose of a path; three are usual
FOLLOW_DAMPING = 1e-3  # that of the executor, so that a redundant arm moves as it was planned
FOLLOWED = 1e-7


@inlined
def _apart(a: Array, b: Array) -> float:
    """Return the largest difference of two (4, 4) poses."""
    most = 0.0
    for r in range(3):
        for k in range(4):
            most = max(most, abs(a[r, k] - b[r, k]))
    return most


@compiled
def exact_branches(dh: Array, found: Array, goal: Array) -> Array:
    """Return the solutions (k, 6) among `found` (m, 6) that reach the pose `goal` (4, 4) exactly, each of them once.

    Solutions with rounding errors, as near a singularity, are improved by Newton steps.
    """
    n = dh.shape[0]
    out = np.empty_like(found)
    eye = np.eye(4)
    count = 0
    for i in range(found.shape[0]):
        q = found[i].copy()
        apart = _apart(frames(dh, q)[n], goal)
        for _ in range(NEWTON_STEPS):
            if not EXACT < apart < NEAR:
                break
            pose, jacobian = tool_and_jacobian(dh, q, eye)
            gram = jacobian @ jacobian.T
            for k in range(6):
                gram[k, k] += 1e-14
            q = q + jacobian.T @ np.linalg.solve(gram, pose_error(goal, pose))
            apart = _apart(frames(dh, q)[n], goal)
        if not apart < RESIDUAL:  # also when it is no number
            continue
        is_new = True
        for j in range(count):
            most = 0.0
            for k in range(n):
                step = q[k] - out[j, k]
                most = max(most, abs(step - TURN_RAD * np.round(step / TURN_RAD)))
            if most < SAME_RAD:
                is_new = False
                break
        if is_new:
            for k in range(n):
                out[count, k] = q[k]
            count += 1
    return out[:count]


@compiled
def whole_turns(lowest: Array, highest: Array, lower: Array, upper: Array) -> Array:
    """Return the whole turns (k, n), rad, that bring joints ranging from `lowest` to `highest` (n,) inside the limits.

    Every joint is turned on its own, so that k is the product of what the joints allow; 0 when one cannot be inside.
    """
    n = lower.shape[0]
    first, counts, total = np.empty(n), np.empty(n, np.int64), 1
    for i in range(n):
        first[i] = TURN_RAD * np.ceil((lower[i] - lowest[i]) / TURN_RAD - 1e-12)
        room = np.floor((upper[i] - highest[i] - first[i]) / TURN_RAD + 1e-12)
        counts[i] = max(0, int(room) + 1)
        total *= counts[i]
    out = np.empty((total, n))
    for row in range(total):
        rest = row
        for i in range(n - 1, -1, -1):
            out[row, i] = first[i] + TURN_RAD * (rest % counts[i])
            rest //= counts[i]
    return out


@compiled
def all_turns(branches: Array, lower: Array, upper: Array) -> Array:
    """Return all joint vectors (k, n) inside the limits that equal one of the branches (m, n) up to whole turns."""
    turns = [whole_turns(branches[i], branches[i], lower, upper) for i in range(branches.shape[0])]
    total = 0
    for some in turns:
        total += some.shape[0]
    out = np.empty((total, branches.shape[1]))
    row = 0
    for i in range(branches.shape[0]):
        for j in range(turns[i].shape[0]):
            for k in range(branches.shape[1]):
                out[row, k] = branches[i, k] + turns[i][j, k]
            row += 1
    return out


@compiled
def followed(dh: Array, start: Array, poses: Array, largest_step: float) -> Array:
    """Return the joints (m, n) that follow the flange poses (N, 4, 4) from `start` (n,), up to the first that fails.

    They take the shortest step to each pose, as the executor of a path does, also where the arm has more joints than
    it needs. A pose fails when it is not reached, or only by a step above `largest_step`.
    """
    n, eye = dh.shape[0], np.eye(4)
    out = np.empty((poses.shape[0], n))
    q = start.copy()
    for i in range(poses.shape[0]):
        before = q
        for _ in range(FOLLOW_STEPS):
            q = follow_pose(dh, eye, q, poses[i], FOLLOW_DAMPING, 1)
            apart = _apart(frames(dh, q)[n], poses[i])
            if apart < FOLLOWED:
                break
        if not apart < FOLLOWED or np.max(np.abs(q - before)) > largest_step:
            return out[:i]
        for k in range(n):
            out[i, k] = q[k]
    return out


def warm(dh: Array) -> None:
    """Compile every function of this file, or load it from the cache."""
    q = np.full(dh.shape[0], 0.1)
    goal = frames(dh, q)[-1]
    exact_branches(dh, q[None], goal)
    whole_turns(q, q, -q, q)
    all_turns(q[None], -q, q)
    followed(dh, q, goal[None], 1.0)
