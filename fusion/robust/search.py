"""Computes poses from small random subsets and refines them on the inliers, compiled.

Annealed truncation alone loses the right pose when a quarter of the measurements are bad; random subsets, some of which
are free of outliers, do not. A subset has one more degree of freedom than the 6 unknowns, so that it can be checked.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch
from fusion.distance.rows import FAR, NEAR, values
from fusion.solve.descent import cost_of, descend
from fusion.solve.placement import place
from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled, inlined
from hal.small_algebra import put1, put2

SUBSET_DOF = 7  # six unknowns and one for a check; with 8, clean subsets are found a third less often
SUBSET_MOST = 8  # largest number of measurements in a subset
ROTATIONS = 3
DRAWS = SUBSET_MOST + 4 * ROTATIONS  # random numbers a hypothesis uses: picks and quaternions
STEPS, ANNEAL_STEPS = as_numpy_scalar(12), as_numpy_scalar(4)
ANNEALED, AS_IT_IS = as_numpy_scalar(True), as_numpy_scalar(False)
FIT_LIMIT = 60.0  # a subset with a larger error at its own pose contains outliers
LEAST_GAIN = 1e-6  # two truncated errors that differ by less count as equal
ANNEAL = (8.0, 4.0, 2.0, 1.0)
OTHERS = 2  # hypotheses of other attitudes that are settled too, because the cheapest ones are often the same pose
OTHER_ATTITUDE = 2.86  # least trace of the rotation between two poses of the same attitude (0.38 rad)
OTHER_COST = 23.0  # largest truncated error above the cheapest one, for a hypothesis that may become an alternative


@inlined
def _rotation(R: Array, x: float, y: float, z: float, w: float) -> None:
    n = math.sqrt(x * x + y * y + z * z + w * w) + 1e-300
    x, y, z, w = x / n, y / n, z / n, w / n
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@inlined
def _pick(b: Batch, draws: Array, h: int, use: Array) -> None:
    """Mark a random subset of SUBSET_DOF degrees of freedom; each entry's probability is proportional to its own.

    The fewer entries a subset has, the more likely all of them are good.
    """
    use[:] = 0.0
    total, dof = 0, 0
    for i in range(b.cls.size):
        total += b.dof[i]
    for k in range(SUBSET_MOST):
        if dof >= SUBSET_DOF or total <= 0:
            break
        left = draws[h, k] * total
        for i in range(b.cls.size):
            if use[i] > 0.0:
                continue
            left -= b.dof[i]
            if left < 0.0:
                use[i] = 1.0
                dof += b.dof[i]
                total -= b.dof[i]
                break


@inlined
def _start(b: Batch, draws: Array, h: int, use: Array, R: Array, t: Array, work: Array) -> None:
    """Set R, t to the best of ROTATIONS random rotations, each with its best translation."""
    R1, t1 = np.empty((3, 3)), np.empty(3)
    least = np.inf
    for k in range(ROTATIONS):
        c = SUBSET_MOST + 4 * k
        _rotation(R1, draws[h, c], draws[h, c + 1], draws[h, c + 2], draws[h, c + 3])
        place(b, use, R1, t1)
        cost = cost_of(b, use, R1, t1, FAR, work)
        if cost < least:
            least = cost
            put2(R, R1)
            put1(t, t1)


@compiled
def hypotheses(b: Batch, draws: Array, Rs: Array, ts: Array, costs: Array) -> None:
    """Compute a pose per row of `draws` (H, DRAWS): Rs (H, 3, 3), ts (H, 3), truncated costs (H,), infinite if bad."""
    n = b.cls.size
    use, f, work = np.empty(n), np.empty(n), np.empty((13, 6))
    for h in range(draws.shape[0]):
        R, t = Rs[h], ts[h]
        _pick(b, draws, h, use)
        if b.cls[n - 1] == 0 and use[n - 1] > 0.0:
            put2(R, b.prior_r)
            put1(t, b.prior_t)
        else:
            _start(b, draws, h, use, R, t, work)
        costs[h] = np.inf
        if descend(b, use, R, t, FAR, STEPS, 1e-2) < FIT_LIMIT:
            values(b, R, t, NEAR, f)
            costs[h] = truncated(b, f)


@inlined
def truncated(b: Batch, f: Array) -> float:
    """Return the truncated error sum min(f_i, gate_i)."""
    cost = 0.0
    for i in range(f.size):
        cost += min(f[i], b.gate[i])
    return cost


@compiled
def candidates(b: Batch, draws: Array, most: int, Rs: Array, ts: Array, costs: Array, inside: NDArray[np.int64]) -> int:
    """Make one round: hypotheses from `draws` (H, DRAWS); the best `most` are settled, and OTHERS of other attitudes.

    The first rows of Rs (H, 3, 3), ts (H, 3) and costs (H,) receive the settled ones, cheapest first, and `inside` (H,)
    the degrees of freedom inside their gates. Returns their number.
    """
    n = b.cls.size
    hypotheses(b, draws, Rs, ts, costs)
    order = np.argsort(costs)
    kept = 0
    f = np.empty(n)
    R, t, cost = np.empty((most + OTHERS, 3, 3)), np.empty((most + OTHERS, 3)), np.empty(most + OTHERS)
    number = np.empty(most + OTHERS, np.int64)
    for rank in range(order.size):
        h = order[rank]
        if not costs[h] < np.inf or kept == most + OTHERS:
            break
        if rank >= most and (costs[h] > costs[order[0]] + OTHER_COST or not _is_other(Rs[h], R, kept)):
            continue
        put2(R[kept], Rs[h])
        put1(t[kept], ts[h])
        cost[kept] = settle(b, R[kept], t[kept], f, ANNEALED)
        number[kept] = 0
        for i in range(n):
            if f[i] < b.gate[i]:
                number[kept] += b.dof[i]
        kept += 1
    order = np.argsort(cost[:kept])
    for k in range(kept):
        put2(Rs[k], R[order[k]])
        put1(ts[k], t[order[k]])
        costs[k], inside[k] = cost[order[k]], number[order[k]]
    return kept


@inlined
def _is_other(R: Array, known: Array, count: int) -> bool:
    """Return whether R (3, 3) has another attitude than the first `count` of `known`."""
    for k in range(count):
        turn = 0.0
        for i in range(3):
            for j in range(3):
                turn += R[i, j] * known[k, i, j]
        if turn > OTHER_ATTITUDE:
            return False
    return True


@compiled
def settle(b: Batch, R: Array, t: Array, f: Array, annealed: bool) -> float:
    """Refine R, t in place on the inliers of a shrinking gate until their set is stable; fills f (N,).

    Returns the truncated error.
    """
    n = b.cls.size
    use, before = np.ones(n), np.ones(n)
    if annealed:
        for k in range(4):
            values(b, R, t, NEAR, f)
            for i in range(n):
                use[i] = 1.0 if f[i] < ANNEAL[k] * b.gate[i] else 0.0
            descend(b, use, R, t, NEAR, ANNEAL_STEPS, 1e-3)
    for _ in range(12):
        values(b, R, t, NEAR, f)
        same = True
        for i in range(n):
            use[i] = 1.0 if f[i] < b.gate[i] else 0.0
            same = same and use[i] == before[i]
            before[i] = use[i]
        if same:
            break
        descend(b, use, R, t, NEAR, STEPS, 1e-8)
    values(b, R, t, NEAR, f)
    return truncated(b, f)


@compiled
def readmit(b: Batch, R: Array, t: Array, cost: float) -> float:
    """Add one rejected measurement at a time, in place, wherever that lowers the truncated error; returns that error.

    `settle` stops where a set and its pose are consistent. That can also happen with one good measurement missing: the
    direction that it would constrain is then fitted to noise, and the measurement looks wrong.
    """
    n = b.cls.size
    use, f, left_out = np.empty(n), np.empty(n), np.empty(n)
    R1, t1 = np.empty((3, 3)), np.empty(3)
    better = True
    while better:
        better = False
        values(b, R, t, NEAR, left_out)
        for i in range(n):
            if left_out[i] < b.gate[i]:
                continue
            put2(R1, R)
            put1(t1, t)
            for k in range(n):
                use[k] = 1.0 if left_out[k] < b.gate[k] or k == i else 0.0
            descend(b, use, R1, t1, NEAR, STEPS, 1e-6)
            now = settle(b, R1, t1, f, AS_IT_IS)
            if now < cost - LEAST_GAIN:
                put2(R, R1)
                put1(t, t1)
                cost, better = now, True
                break
    return cost
