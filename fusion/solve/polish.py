"""The last steps to the minimum of the exact error E = sum f_i, and the information there, compiled (paper eq 11).

The gradient is exact (envelope theorem) and the Hessian first order, so each step reduces the error by about a factor
of a hundred, which is the relative accuracy of the Hessian.
"""

from __future__ import annotations

import numpy as np

from fusion.batch import Batch
from fusion.distance.exact import evaluate
from fusion.distance.rows import FAR, NEAR, rows
from fusion.solve.descent import FLOOR, accumulate, descend
from fusion.vectors import move
from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled
from hal.least_squares import solve_damped

COARSE_STEPS, FINE_STEPS = as_numpy_scalar(30), as_numpy_scalar(20)
ANYWHERE = as_numpy_scalar(True)


@compiled
def polish(  # noqa: PLR0912 - one flat loop, for the compiler
    b: Batch, use: Array, R: Array, t: Array, steps: int, H: Array, f: Array, grad: Array, direction: Array
) -> float:
    """Move R, t in place to the minimum of the exact E over used entries; returns the last step's predicted decrease.

    Fills H (6, 6) with the information sum J^T J at the end, f (N,), grad (N, 6) and v* (N, 3) with exact values there.
    """
    n = b.cls.size
    g, step, L, work = np.empty(6), np.empty(6), np.empty((6, 6)), np.empty((13, 6))
    prior = np.zeros(n)
    for i in range(n):
        prior[i] = 1.0 if b.cls[i] == 0 else 0.0
    fall = np.inf
    for k in range(steps):
        evaluate(b, R, t, k == 0, f, grad, direction)
        accumulate(b, prior * use, R, t, NEAR, H, g, work)
        for j in range(6):
            step[j] = -g[j]
        for i in range(n):
            if use[i] > 0.0:
                for j in range(6):
                    step[j] -= 0.5 * grad[i, j]
        accumulate(b, use, R, t, NEAR, H, g, work)
        size = 0.0
        for j in range(6):
            size = max(size, H[j, j])
        predicted = solve_damped(H, H, 0.0, FLOOR * size, 0.0, step, L, 6)
        if predicted < 0.0:
            break
        fall = predicted
        if fall < 1e-20:
            break
        if step[3] ** 2 + step[4] ** 2 + step[5] ** 2 > 1.0:
            break
        move(R, t, step)
    evaluate(b, R, t, ANYWHERE, f, grad, direction)
    accumulate(b, use, R, t, NEAR, H, g, work)
    for i in range(n):
        if b.cls[i] == 0:
            r = work[0]
            rows(b, i, R, t, NEAR, r, work[1:7], work[7:13])
            f[i] = 0.0
            for j in range(6):
                f[i] += r[j] ** 2
    for j in range(6):
        for k in range(j):
            H[k, j] = H[j, k]
    return fall


@compiled
def solve_from(
    b: Batch, use: Array, R: Array, t: Array, far: bool, H: Array, f: Array, grad: Array, direction: Array
) -> float:
    """Solve locally from R, t (moved in place): coarse and fine Levenberg-Marquardt, then `polish`."""
    if far:
        descend(b, use, R, t, FAR, COARSE_STEPS, 1e-2)
    descend(b, use, R, t, NEAR, FINE_STEPS, 1e-9)
    return polish(b, use, R, t, 4, H, f, grad, direction)
