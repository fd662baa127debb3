"""The best translation at a known rotation: a linear problem, the start of every local solve, compiled."""

from __future__ import annotations

import numpy as np

from fusion.batch import Batch
from fusion.distance.rows import FAR, rows
from fusion.vectors import turned, vec
from hal.arrays import Array
from hal.jit import compiled
from hal.small_algebra import solve_positive


@compiled
def place(b: Batch, use: Array, R: Array, t: Array) -> None:  # noqa: PLR0912 - one flat loop, for the compiler
    """Set t (3,) in place to the translation that fits the used entries best at rotation R, all rows with equal weight.

    At a fixed rotation all rows are linear in t. Directions that they leave free are taken from the centroids; there
    lines and planes seen by a camera do not count, because their mu is the camera.
    """
    r, J, V = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    A, x = np.zeros((3, 3)), np.zeros(3)
    n = 0.0
    for k in range(3):
        t[k] = 0.0
    for camera in (False, True):
        for i in range(b.cls.size):
            c = b.cls[i]
            if use[i] <= 0.0 or c == 0 or ((c in (4, 8)) != camera):
                continue
            q = turned(R, vec(b.m, i))
            t[0] += b.mu[i, 0] - q[0]
            t[1] += b.mu[i, 1] - q[1]
            t[2] += b.mu[i, 2] - q[2]
            n += 1.0
        if n > 0.0:
            break
    for k in range(3):
        t[k] /= max(n, 1.0)
        A[k, k] = 1e-3
    for i in range(b.cls.size):
        if use[i] <= 0.0 or b.cls[i] == 0:
            continue
        for k in range(rows(b, i, R, t, FAR, r, J, V)):
            for p in range(3):
                x[p] -= J[k, p] * r[k]
                for c in range(p + 1):
                    A[p, c] += J[k, p] * J[k, c]
    if solve_positive(A, x, 3):
        for k in range(3):
            t[k] += x[k]
