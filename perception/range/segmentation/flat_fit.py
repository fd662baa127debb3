"""Planes from sums over blocks, and the test whether a quadratic describes the same blocks clearly better.

Fits are linear in g = 1 / z (pinhole) or g = z (parallel rays): a plane is g = a x + b y + c in ray coordinates x, y.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import as_numpy_scalar, compiled
from hal.small_algebra import solve_positive

BEND_RMS = 0.4  # sigmas; blocks are curved if a quadratic reduces the mean squared residual by more than its square
BEND_F = 4.0  # F ratio that this reduction must also exceed to be significant
WORST_MEAN_SQUARE = 3.0  # squared sigmas; blocks with a larger mean square about their plane are not planar
OF_PLANE, OF_BENT = as_numpy_scalar(3), as_numpy_scalar(6)  # number of coefficients of a plane and of a quadratic
# Index of each product of two of 1, p, q, pp, pq, qq in the list of moments
# 1, p, q, pp, pq, qq, ppp, ppq, pqq, qqq, pppp, pppq, ppqq, pqqq, qqqq.
MOMENTS = np.array(
    [
        [0, 1, 2, 3, 4, 5],
        [1, 3, 4, 6, 7, 8],
        [2, 4, 5, 7, 8, 9],
        [3, 6, 7, 10, 11, 12],
        [4, 7, 8, 11, 12, 13],
        [5, 8, 9, 12, 13, 14],
    ]
)


@compiled
def solve3(S: Array, out: Array) -> bool:
    """Solve g = a x + b y + c for (a, b, c) by least squares; returns False if the blocks do not determine a plane.

    `S` (9,) are the weighted sums of 1, x, y, xx, xy, yy, g, xg and yg over the blocks.
    """
    n = S[0]
    if n <= 0.0:
        return False
    mx, my, mg = S[1] / n, S[2] / n, S[6] / n
    sxx, sxy, syy = S[3] / n - mx * mx, S[4] / n - mx * my, S[5] / n - my * my
    sxg, syg = S[7] / n - mx * mg, S[8] / n - my * mg
    det = sxx * syy - sxy * sxy
    if det <= 1e-6 * sxx * syy or det <= 0.0:
        return False
    out[0] = (syy * sxg - sxy * syg) / det
    out[1] = (sxx * syg - sxy * sxg) / det
    out[2] = mg - out[0] * mx - out[1] * my
    return True


@compiled
def plane_from_coefficients(m: Array, perspective: bool, th: Array) -> None:
    """Write the PLANE parameters of g = m . (x, y, 1), with the normal towards the sensor, into `th` (16,)."""
    if perspective:
        nx, ny, nz, d = m[0], m[1], m[2], 1.0  # (a, b, c) . X = 1 and z > 0: this normal points away
    else:
        nx, ny, nz, d = -m[0], -m[1], 1.0, m[2]
    length = -np.sqrt(nx * nx + ny * ny + nz * nz)
    th[0], th[1], th[2], th[3] = nx / length, ny / length, nz / length, d / length


@compiled
def moved_rms(a: float, b: float, c: float, S: Array, count: int) -> float:
    """Return the root mean square of a x + b y + c in sigmas over `count` blocks with the sums `S` of `solve3`.

    With the differences of two planes' coefficients it is how far one plane lies from the other.
    """
    n, x, y = S[0], S[1] / S[0], S[2] / S[0]
    xx, xy, yy = S[3] / n - x * x, S[4] / n - x * y, S[5] / n - y * y
    square = (a * x + b * y + c) ** 2 + a * a * xx + 2.0 * a * b * xy + b * b * yy
    return float(np.sqrt(max(square, 0.0) * n / count))


@compiled
def squares_left(idx: Labels, count: int, table: Array, x0: float, y0: float, scale: float) -> tuple[float, float]:
    """Return the residual sums of squares, in squared sigmas, of a plane and of a quadratic fitted to some blocks.

    The blocks are the rows idx[:count] of the `table` of `grow_planes`. For accuracy, coordinates are shifted by x0, y0
    and divided by `scale`.
    """
    M, b, total = np.zeros(15), np.zeros(6), 0.0
    g0, per = table[idx[0], 2], 1.0 / scale
    for k in range(count):
        i = idx[k]
        p, q, v, w = (table[i, 0] - x0) * per, (table[i, 1] - y0) * per, table[i, 2] - g0, table[i, 3]
        pp, pq, qq, wv = p * p, p * q, q * q, w * v
        wpp, wpq, wqq = w * pp, w * pq, w * qq
        total += wv * v
        for m, value in enumerate((w, w * p, w * q, wpp, wpq, wqq, wpp * p, wpp * q, wqq * p, wqq * q)):
            M[m] += value
        for m, value in enumerate((wpp * pp, wpp * pq, wpp * qq, wpq * qq, wqq * qq)):
            M[10 + m] += value
        for m, value in enumerate((wv, wv * p, wv * q, wv * pp, wv * pq, wv * qq)):
            b[m] += value
    A = np.empty((6, 6))
    # Normal matrix of the basis 1, p, q, pp, pq, qq, from the moments.
    for a, row in enumerate(MOMENTS):
        for e in range(6):
            A[a, e] = M[row[e]] * (1.0 + 1e-9 if a == e else 1.0)
    plane, full = b[:3].copy(), b.copy()
    if not solve_positive(A[:3, :3].copy(), plane, OF_PLANE):
        return float(max(total, 0.0)), float(max(total, 0.0))
    left = max(float(total - plane @ b[:3]), 0.0)
    if not solve_positive(A, full, OF_BENT):
        return left, left
    return left, max(float(total - full @ b), 0.0)


@compiled
def is_bent(flat: float, quadratic: float, count: int) -> bool:
    """Return whether `count` blocks are not planar, from the residual sums of squares of a plane and of a quadratic."""
    ratio = (flat - quadratic) / 3.0 / max(quadratic / max(count - 6, 1), 0.3)
    is_better = flat - quadratic > BEND_RMS * BEND_RMS * count and ratio > BEND_F
    return is_better or flat > WORST_MEAN_SQUARE * count
