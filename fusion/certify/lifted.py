"""The error at frozen covariances as one quadratic form over z = (1, vec R, t, -R^T t), compiled.

With s = -R^T t the rows of `fusion.distance.rows` are linear in z,

    A = a^T m - a^T s - a^T R^T mu      B = n^T (R m + t - mu)      D = n^T R w.
"""

from __future__ import annotations

import numpy as np

from fusion.batch import Batch
from fusion.distance.rows import NEAR, rows
from fusion.vectors import Vec, across, cholesky, cross, turned, vec
from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import put2

SIZE = 16  # numbers in z: 1, R row by row at 1, t at 10, s at 13


@inlined
def _row_a(Z: Array, k: int, R: Array, n: Vec, m: Vec, mu: Vec, size: float) -> None:
    """Fill row A of the object direction a = R^T n."""
    Z[k, :] = 0.0
    for j in range(3):
        a = R[0, j] * n[0] + R[1, j] * n[1] + R[2, j] * n[2]
        Z[k, 0] += a * m[j]
        Z[k, 13 + j] = -size * a
        for i in range(3):
            Z[k, 1 + 3 * i + j] = -mu[i] * a


@inlined
def _row_b(Z: Array, k: int, n: Vec, m: Vec, mu: Vec, size: float) -> None:
    Z[k, :] = 0.0
    for i in range(3):
        Z[k, 0] -= n[i] * mu[i]
        Z[k, 10 + i] = size * n[i]
        for j in range(3):
            Z[k, 1 + 3 * i + j] = n[i] * m[j]


@inlined
def _row_d(Z: Array, k: int, n: Vec, w: Vec) -> None:
    Z[k, :] = 0.0
    for i in range(3):
        for j in range(3):
            Z[k, 1 + 3 * i + j] = n[i] * w[j]


@inlined
def _rows_of(b: Batch, i: int, R: Array, about: Vec, middle: Vec, size: float, Z: Array) -> None:
    """Fill the rows Z of entry i over z, in the order of `distance.rows`."""
    c = b.cls[i]
    w, u = vec(b.w, i), turned(R, vec(b.w, i))
    m = (b.m[i, 0] - about[0], b.m[i, 1] - about[1], b.m[i, 2] - about[2])
    mu = (b.mu[i, 0] - middle[0], b.mu[i, 1] - middle[1], b.mu[i, 2] - middle[2])
    d, a1, a2 = vec(b.d, i), vec(b.a1, i), vec(b.a2, i)
    if c == 1:
        _row_b(Z, 0, (1.0, 0.0, 0.0), m, mu, size)
        _row_b(Z, 1, (0.0, 1.0, 0.0), m, mu, size)
        _row_b(Z, 2, (0.0, 0.0, 1.0), m, mu, size)
    elif c == 4:
        _row_b(Z, 0, a1, m, mu, size)
        _row_b(Z, 1, a2, m, mu, size)
    elif c in (7, 8):
        _row_b(Z, 0, d, m, mu, size)
        _row_d(Z, 1, d, w)
    elif c in (2, 5):
        n1 = across(u)
        _row_a(Z, 0, R, n1, m, mu, size)
        _row_a(Z, 1, R, cross(u, n1), m, mu, size)
        _row_d(Z, 2, a1, w)
        _row_d(Z, 3, a2, w)
    else:
        _row_a(Z, 0, R, u, m, mu, size)
        _row_d(Z, 1, d if c == 6 else a1, w)
        _row_d(Z, 2, a2, w)


@inlined
def _prior_rows(b: Batch, about: Vec, middle: Vec, size: float, Z: Array) -> None:
    """Fill the whitened rows of a prior pose: t - t0 exactly, and the vector part of R R0^T (first order)."""
    plain = np.zeros((6, SIZE))
    m = (-about[0], -about[1], -about[2])
    t0 = (b.prior_t[0] - middle[0], b.prior_t[1] - middle[1], b.prior_t[2] - middle[2])
    for k in range(3):
        n = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
        _row_b(plain, k, n, m, t0, size)
        for j in range(3):  # 0.5 sum_j r0_j x r_j = sin(angle) axis; row k of it is 0.5 sum_j (n x r0_j) . r_j
            side = cross(n, (b.prior_r[0, j], b.prior_r[1, j], b.prior_r[2, j]))
            for i in range(3):
                plain[3 + k, 1 + 3 * i + j] = 0.5 * side[i]
    put2(Z, b.prior_w @ plain)


@compiled
def lift(b: Batch, R: Array, t: Array, about: Array, middle: Array, size: float, out: Array) -> None:
    """Compute out (N, 16, 16) with z^T out_i z = first-order local pose function of entry i, covariance frozen at R, t.

    Features are relative to `about` (3,), object frame, and sensed points to `middle` (3,), base frame, in units of
    `size`.
    """
    r, J, V, Z = np.empty(6), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, SIZE))
    centre, origin = (about[0], about[1], about[2]), (middle[0], middle[1], middle[2])
    for i in range(b.cls.size):
        count = rows(b, i, R, t, NEAR, r, J, V)
        if b.cls[i] == 0:
            _prior_rows(b, centre, origin, size, Z)
        else:
            _rows_of(b, i, R, centre, origin, size, Z)
            cholesky(V, count)
            for row in range(count):
                for c in range(row):
                    for k in range(SIZE):
                        Z[row, k] -= V[row, c] * Z[c, k]
                for k in range(SIZE):
                    Z[row, k] /= V[row, row]
        for p in range(SIZE):
            for q in range(SIZE):
                s = 0.0
                for row in range(count):
                    s += Z[row, p] * Z[row, q]
                out[i, p, q] = s
