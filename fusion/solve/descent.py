"""Descent on the sum of squares of the whitened rows, compiled: from anywhere, or the last steps."""

from __future__ import annotations

import numpy as np

from fusion.batch import Batch
from fusion.distance.rows import rows, whitened
from fusion.vectors import cholesky, move
from hal.arrays import Array
from hal.jit import compiled
from hal.least_squares import DampingRule, next_damping, solve_damped
from hal.small_algebra import put1, put2, solve_lower

RULE = DampingRule(fall=0.1, rise=8.0, least=1e-9, restart=1e-6, most=1e8)
FLOOR = 1e-12  # of the information, relative to its largest entry, because measurements may leave a motion free


@compiled
def accumulate(b: Batch, use: Array, R: Array, t: Array, far: bool, H: Array, g: Array, work: Array) -> float:
    """Compute H (6, 6) lower = sum J^T J, g (6,) = sum J^T r over entries with use > 0; returns sum |r|^2.

    work: (13, 6) scratch.
    """
    r, J, V = work[0], work[1:7], work[7:13]
    for j in range(6):
        g[j] = 0.0
        for k in range(6):
            H[j, k] = 0.0
    cost = 0.0
    for i in range(b.cls.size):
        if use[i] <= 0.0:
            continue
        n = whitened(b, i, R, t, far, r, J, V)
        for k in range(n):
            cost += r[k] * r[k]
            for p in range(6):
                g[p] += J[k, p] * r[k]
                for c in range(p + 1):
                    H[p, c] += J[k, p] * J[k, c]
    return cost


@compiled
def cost_of(b: Batch, use: Array, R: Array, t: Array, far: bool, work: Array) -> float:
    """Return sum |r|^2 over entries with use > 0."""
    r, J, V = work[0], work[1:7], work[7:13]
    cost = 0.0
    for i in range(b.cls.size):
        if use[i] <= 0.0:
            continue
        k = rows(b, i, R, t, far, r, J, V)
        if b.cls[i] != 0:
            if not cholesky(V, k):
                continue
            solve_lower(V, r, k)
        for j in range(k):
            cost += r[j] * r[j]
    return cost


@compiled
def descend(b: Batch, use: Array, R: Array, t: Array, far: bool, steps: int, tolerance: float) -> float:
    """Minimise sum |r|^2 over entries with use > 0 by Levenberg-Marquardt, moving R, t in place; returns the cost.

    The step is damped in proportion to the diagonal of J^T J (Marquardt), so metres and radians need no common scale.
    It stops when the predicted decrease is below `tolerance`.
    """
    H, L, g, step = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.empty(6)
    H1, g1, work = np.empty((6, 6)), np.empty(6), np.empty((13, 6))
    R1, t1 = np.empty((3, 3)), np.empty(3)
    damping, swapped = (1e-3 if far else 1e-6), False
    cost = accumulate(b, use, R, t, far, H, g, work)
    for _ in range(steps):
        size = 0.0
        for j in range(6):
            size = max(size, H[j, j])
            step[j] = -g[j]
        fall = solve_damped(H, H, damping, FLOOR * size, 0.0, step, L, 6)
        if fall < 0.0:
            damping = next_damping(damping, False, RULE)
            continue
        turn = step[3] ** 2 + step[4] ** 2 + step[5] ** 2
        if turn > 1.0:  # the linearisation is not valid beyond a radian
            for j in range(6):
                step[j] /= turn**0.5
        put1(t1, t)
        put2(R1, R)
        move(R1, t1, step)
        # Most steps are taken, so the next system is built at once instead of the cost alone.
        lower = accumulate(b, use, R1, t1, far, H1, g1, work)
        is_lower = lower < cost
        if is_lower:
            R, R1, t, t1 = R1, R, t1, t
            H, H1, g, g1 = H1, H, g1, g
            swapped = not swapped
            cost = lower
        damping = next_damping(damping, is_lower, RULE)
        if fall < tolerance or damping > RULE.most:
            break
    if swapped:  # R1 and t1 are the arguments
        put2(R1, R)
        put1(t1, t)
    return cost
