"""The last step of a fit, on all pixels of a region, read from the image run by run in chunks of rays.

The pixels of a region are never copied into one array, because a region may have a hundred thousand of them.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import REORDERED, as_numpy_scalar, compiled
from hal.least_squares import solve_damped
from hal.small_algebra import LEAST_PIVOT
from perception.range.fitting.equations import TRIM_SIGMAS, add_equations
from perception.range.fitting.rays import CHUNK, SCRATCH, SIGMA, X, Y, Z, fill_rows
from perception.range.fitting.refine import FLOOR
from perception.range.fitting.surfaces import FREEDOM, GRAZING_COSINE, PLANE, SIZE, frame_of, step_into

STEP_FOLLOWS = as_numpy_scalar(True)


@compiled
def last_step(
    kind: int, th: Array, depth: Array, sen: Array, noise: Array, runs: Labels,
) -> tuple[Array, Array, float, int]:  # fmt: skip
    """Take one Gauss-Newton step on the pixels of runs (R, 3), in one pass, from parameters that are already close.

    The matrix and the trim are evaluated at the initial parameters; the cost after the step is that of the quadratic
    model.

    Returns:
        parameters, information matrix (9, 9), sum of squared residuals of the kept pixels, number of pixels kept.
    """
    p = FREEDOM[kind]
    H, g, frame = np.zeros((9, 9)), np.zeros(9), np.empty(6)
    frame_of(kind, th, frame)
    kept, used = _equations(kind, th, frame, depth, sen, noise, runs, np.empty(SCRATCH), H, g)
    step = g.copy()
    if used <= p or solve_damped(H, H, 0.0, FLOOR, LEAST_PIVOT, step, np.empty((p, p)), p) < 0.0:
        return th, H, kept, used
    for a in range(p):
        kept -= g[a] * step[a]
    moved = np.empty(SIZE)
    step_into(kind, th, frame, step, moved)
    return moved, H, max(kept, 0.0), used


@compiled
def _equations(
    kind: int, th: Array, frame: Array, depth: Array, sen: Array, noise: Array, runs: Labels, work: Array,
    H: Array, g: Array,
) -> tuple[float, int]:  # fmt: skip
    """Add up the Gauss-Newton matrix `H` and gradient `g` of the pixels within the trim.

    Returns the sum of the squared residuals of these pixels, and their number.
    """
    perspective = sen[0] > 0
    cost, used, n, pixels = 0.0, 0.0, 0, 0
    last = runs.shape[0] - 1
    for i in range(runs.shape[0]):
        v, first, end = runs[i, 0], 0 + runs[i, 1], runs[i, 2]
        pixels += end - first
        while first < end:
            m = min(end - first, CHUNK - n)
            _load(depth[v, first : first + m], first, v, sen, work[n:])
            n, first = n + m, first + m
            if n == CHUNK or (i == last and first == end):
                variances = work[SIGMA : SIGMA + n]
                fill_variances(work[Z : Z + n], noise, variances)
                if kind == PLANE:
                    more, hits = _add_plane(th, frame, n, perspective, work, H, g)
                else:
                    variances[:] = np.sqrt(variances)
                    fill_rows(kind, th, frame, n, perspective, work)
                    more, hits = add_equations(kind, n, 0.0, work, H, g, STEP_FOLLOWS)
                cost, used, n = cost + more, used + hits, 0
    for a in range(FREEDOM[kind]):
        for b in range(a):
            H[b, a] = H[a, b]
    return max(cost - (pixels - used) * TRIM_SIGMAS * TRIM_SIGMAS, 0.0), int(used)


@compiled
def _load(depth: Array, first: int, row: int, sen: Array, work: Array) -> None:
    """Write the pixels of a run that begins at column `first` into the rows X, Y and Z of `work`."""
    per_x, y = 1.0 / sen[1], (row - sen[4]) / sen[2]
    n = depth.shape[0]
    for k in range(n):
        work[X + k] = (float(np.int32(first + k)) - sen[3]) * per_x
    for k in range(n):
        work[Y + k] = y
    for k in range(n):
        work[Z + k] = depth[k]


@compiled(fastmath=REORDERED)
def _add_plane(
    th: Array, frame: Array, n: int, perspective: bool, work: Array, H: Array, g: Array,
) -> tuple[float, float]:  # fmt: skip
    """Do the work of `fill_rows` and `add_equations` for a plane in one loop without a square root.

    Most pixels lie on planes, so this case is worth a loop of its own. Row SIGMA holds variances here. Adds w^2 J'J to
    `H` and w^2 J'r to `g`, with the squared weight w^2 = min(1, (c / GRAZING_COSINE)^2) / sigma^2 and c the cosine of
    incidence.
    """
    p, limit = 1.0 if perspective else 0.0, TRIM_SIGMAS * TRIM_SIGMAS
    nx, ny, nz, d = th[0], th[1], th[2], th[3]
    e0, e1, e2, f0, f1, f2 = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    h00, h10, h11, h20, h21, h22, g0, g1, g2, cost, used = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        x, y, z = work[X + i], work[Y + i], work[Z + i]
        dx, dy = p * x, p * y
        ox, oy = x - dx, y - dy
        facing = nx * dx + ny * dy + nz
        is_met = abs(facing) > 1e-6
        k = -1.0 / (facing if is_met else 1.0)
        zm = (nx * ox + ny * oy - d) * k
        square = GRAZING_COSINE * GRAZING_COSINE * (dx * dx + dy * dy + 1.0)
        w2 = min(square, facing * facing) / (square * work[SIGMA + i])
        r = z - zm
        misfit = r * r * w2
        kept = is_met & (misfit <= limit)
        w2 = w2 if kept else 0.0
        px, py = ox + zm * dx, oy + zm * dy
        a, b = k * (px * e0 + py * e1 + zm * e2), k * (px * f0 + py * f1 + zm * f2)
        wa, wb, wk = w2 * a, w2 * b, w2 * k
        h00, h10, h11 = h00 + wa * a, h10 + wb * a, h11 + wb * b
        h20, h21, h22 = h20 - wk * a, h21 - wk * b, h22 + wk * k
        g0, g1, g2 = g0 + wa * r, g1 + wb * r, g2 - wk * r
        cost += misfit if kept else limit
        used += 1.0 if kept else 0.0
    H[0, 0] += h00
    H[1, 0] += h10
    H[1, 1] += h11
    H[2, 0] += h20
    H[2, 1] += h21
    H[2, 2] += h22
    g[0] += g0
    g[1] += g1
    g[2] += g2
    return cost, used


@compiled(fastmath=REORDERED)
def fill_variances(z: Array, noise: Array, out: Array) -> None:
    """Write the variance (`sigma_at` squared) of each depth z (N,) into `out` (N,), without a branch."""
    a, b, c, d, e, f = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    for k in range(z.shape[0]):
        z2 = z[k] * z[k]
        white, slow, step = a + b * z2, c + d * z2, e + f * z2
        out[k] = max(white * white, step * step * (1.0 / 12.0)) + slow * slow
