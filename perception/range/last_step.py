"""The last step of a fit, on all pixels of a region: read from the image run by run, a chunk of rays at a time.

Nothing but the image is read: what a region of a hundred thousand pixels holds is never written down.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.fit import TRIM_SIGMAS, damped
from perception.range.rays import CHUNK, LOOSE, SCRATCH, SIGMA, X, Y, Z, add_equations, fill_rows, mirror
from perception.range.starts import solve_positive
from perception.range.surfaces import FREEDOM, LEAN, SIZE, frame_of, step_into


@njit(cache=True, error_model="numpy", nogil=True)
def last_step(kind, th, depth, sen, noise, slack, runs, fixed):  # type: ignore[no-untyped-def]  # numba types it
    """One Gauss-Newton step on the pixels of runs (R, 3) from a start that is good already, in a single pass over them.

    The matrix and the trim are those of the start; the cost after the step follows from the quadratic model.
    `slack`: how many times the noise is tolerated.

    Returns:
        parameters, information matrix (9, 9), squared residuals of the kept pixels, pixels kept.
    """
    p = FREEDOM[kind]
    H, g = np.zeros((9, 9)), np.zeros(9)
    kept, used = _equations(kind, th, depth, sen, noise, slack, runs, H, g)
    A, step = np.empty((p, p)), np.empty(p)
    damped(H, g, fixed, 0.0, p, A, step)
    if used <= p or not solve_positive(A, step, p):
        return th, H, kept, used
    for a in range(p):
        kept -= 0.0 if fixed[a] else g[a] * step[a]
    frame, moved = np.zeros(6), np.empty(SIZE)
    frame_of(kind, th, frame)
    step_into(kind, th, frame, step, moved)
    return moved, H, max(kept, 0.0), used


@njit(cache=True, error_model="numpy", nogil=True)
def _equations(kind, th, depth, sen, noise, slack, runs, H, g):  # type: ignore[no-untyped-def]  # numba types it
    """Gauss-Newton matrix and gradient of the pixels within the trim; their squared residuals, and how many they are."""
    frame, work = np.zeros(6), np.empty(SCRATCH)
    frame_of(kind, th, frame)
    perspective = sen[0] > 0
    cost, used, n, pixels = 0.0, 0.0, 0, 0
    last = runs.shape[0] - 1
    for i in range(runs.shape[0]):
        v, first, end = runs[i, 0], runs[i, 1], runs[i, 2]
        pixels += end - first
        while first < end:
            m = min(end - first, CHUNK - n)
            _load(depth[v, first : first + m], first, v, sen, work[n:])
            n, first = n + m, first + m
            if n == CHUNK or (i == last and first == end):
                _fill_sigmas(n, noise, slack, work)
                fill_rows(kind, th, frame, n, perspective, work)
                more, hits = add_equations(kind, n, 0.0, TRIM_SIGMAS, work, H, g)
                cost, used, n = cost + more, used + hits, 0
    mirror(FREEDOM[kind], H)
    return max(cost - (pixels - used) * TRIM_SIGMAS * TRIM_SIGMAS, 0.0), int(used)


@njit(cache=True, error_model="numpy", **LEAN)
def _load(depth, first, row, sen, work):  # type: ignore[no-untyped-def]  # numba types it
    """The pixels of a run that begins at column `first` as samples."""
    per_x, y = 1.0 / sen[1], (row - sen[4]) / sen[2]
    n = depth.shape[0]
    for k in range(n):
        work[X + k] = (float(np.int32(first + k)) - sen[3]) * per_x
    for k in range(n):
        work[Y + k] = y
    for k in range(n):
        work[Z + k] = depth[k]


@njit(cache=True, error_model="numpy", **LEAN, fastmath=LOOSE)
def _fill_sigmas(n, noise, slack, work):  # type: ignore[no-untyped-def]  # numba types it
    """`sigma_at` of the loaded depths, without a branch."""
    a, b, c, d, e, f = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    for k in range(n):
        z = work[Z + k]
        z2 = z * z
        white, slow, step = a + b * z2, c + d * z2, e + f * z2
        work[SIGMA + k] = slack * np.sqrt(max(white * white, step * step / 12.0) + slow * slow)
