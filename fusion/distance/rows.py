"""Whitened residual rows of the nine classes, compiled.

With e = R m + t - mu, the three kinds of row and their derivatives over (translation, rotation) are

    A   (R a)^T e    [R a,  R a x e + R m x R a]
    B   n^T e        [n,    R m x n]
    D   n^T R w      [0,    R w x n]

Classes 1, 2, 3, 5 and 9 are exact; 4, 6, 7 and 8 are first order in the direction error, and `exact` finishes them.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.batch import Batch
from fusion.vectors import Sym, Vec, across, cholesky, cross, dot, form, rotation_vector, sym, turned, vec
from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled, inlined
from hal.small_algebra import solve_lower

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
NEAR, FAR = (
    as_numpy_scalar(False),
    as_numpy_scalar(True),
)  # values of `far`: the last steps at the solution, or the first steps from anywhere
FLOOR = 1e-6  # share of the direction variance that is kept where u^T S u vanishes far from the solution


@inlined
def _put(J: Array, k: int, n: Vec, c: Vec, moved: float) -> None:
    J[k, 0], J[k, 1], J[k, 2] = moved * n[0], moved * n[1], moved * n[2]
    J[k, 3], J[k, 4], J[k, 5] = c[0], c[1], c[2]


@inlined
def _row_a(r: Array, J: Array, k: int, n: Vec, e: Vec, q: Vec) -> None:
    a, b = cross(n, e), cross(q, n)
    r[k] = dot(n, e)
    _put(J, k, n, (a[0] + b[0], a[1] + b[1], a[2] + b[2]), 1.0)


@inlined
def _row_b(r: Array, J: Array, k: int, n: Vec, e: Vec, q: Vec) -> None:
    r[k] = dot(n, e)
    _put(J, k, n, cross(q, n), 1.0)


@inlined
def _row_d(r: Array, J: Array, k: int, n: Vec, g: Vec) -> None:
    r[k] = dot(n, g)
    _put(J, k, n, cross(g, n), 0.0)


@inlined
def _variance(p: float) -> float:
    """Return 1/p, or a very large number where nothing is known."""
    return 1.0 / p if p > 1e-12 else 1e12


@compiled
def rows(b: Batch, i: int, R: Array, t: Array, far: bool, r: Array, J: Array, V: Array) -> int:
    """Fill residuals r (6,), Jacobian J (6, 6) and their covariance V (6, 6) of entry i; returns the number of rows.

    `far`: away from the solution the direction variance is averaged over directions, so that it cannot vanish.
    """
    c = b.cls[i]
    if c == 0:
        return _prior_rows(b, R, t, r, J, V)
    q = turned(R, vec(b.m, i))
    mu = vec(b.mu, i)
    e = (q[0] + t[0] - mu[0], q[1] + t[1] - mu[1], q[2] + t[2] - mu[2])
    C = sym(b.C, i)
    if c == 1:
        for k in range(3):
            n = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
            _row_b(r, J, k, n, e, q)
        V[0, 0], V[1, 0], V[1, 1], V[2, 0], V[2, 1], V[2, 2] = C[0], C[1], C[3], C[2], C[4], C[5]
        return 3
    d, a1, a2 = vec(b.d, i), vec(b.a1, i), vec(b.a2, i)
    v1, v2 = _variance(b.p[i, 0]), _variance(b.p[i, 1])
    if c == 4:
        lever = dot(d, e) ** 2
        _row_b(r, J, 0, a1, e, q)
        _row_b(r, J, 1, a2, e, q)
        V[0, 0], V[1, 0], V[1, 1] = form(a1, C, a1) + lever * v1, form(a1, C, a2), form(a2, C, a2) + lever * v2
        return 2
    e1, e2 = dot(a1, e), dot(a2, e)
    if c == 7:
        _row_b(r, J, 0, d, e, q)
        V[0, 0] = form(d, C, d) + v1 * e1 * e1 + v2 * e2 * e2
        return 1
    w = vec(b.w, i)
    u = turned(R, w)
    if c == 8:
        u1, u2 = dot(a1, u), dot(a2, u)
        _row_b(r, J, 0, d, e, q)
        _row_d(r, J, 1, d, u)
        V[0, 0] = form(d, C, d) + v1 * e1 * e1 + v2 * e2 * e2
        if far:
            V[1, 0], V[1, 1] = 0.0, 0.5 * (v1 + v2)
        else:
            V[1, 0], V[1, 1] = v1 * e1 * u1 + v2 * e2 * u2, v1 * u1 * u1 + v2 * u2 * u2 + FLOOR * (v1 + v2)
        return 2
    return _rows_about_direction(c, e, q, C, d, a1, a2, v1, v2, u, far, r, J, V)


@inlined
def _rows_about_direction(
    c: int, e: Vec, q: Vec, C: Sym, d: Vec, a1: Vec, a2: Vec, v1: float, v2: float, u: Vec, far: bool,
    r: Array, J: Array, V: Array,
) -> int:  # fmt: skip
    """Fill the rows of classes 2, 3, 5, 6 and 9, in which a direction u = R w of the object multiplies e."""
    if c in (2, 5):
        n1 = across(u)
        n2 = cross(u, n1)
        _row_a(r, J, 0, n1, e, q)
        _row_a(r, J, 1, n2, e, q)
        V[0, 0], V[1, 0], V[1, 1] = form(n1, C, n1), form(n1, C, n2), form(n2, C, n2)
        if c == 2:
            return 2
        _direction_rows(r, J, V, 2, a1, a2, v1, v2, u)
        return 4
    _row_a(r, J, 0, u, e, q)
    V[0, 0] = form(u, C, u)
    if c == 3:
        return 1
    if c == 6:
        u1, u2 = dot(a1, u), dot(a2, u)
        _row_d(r, J, 1, d, u)
        V[1, 0] = 0.0
        V[1, 1] = 0.5 * (v1 + v2) if far else v1 * u1 * u1 + v2 * u2 * u2 + FLOOR * (v1 + v2)
        return 2
    _direction_rows(r, J, V, 1, a1, a2, v1, v2, u)
    return 3


@inlined
def _direction_rows(r: Array, J: Array, V: Array, k: int, a1: Vec, a2: Vec, v1: float, v2: float, u: Vec) -> None:
    """Fill rows D(a1), D(a2) at k and k + 1, independent of the rows before."""
    _row_d(r, J, k, a1, u)
    _row_d(r, J, k + 1, a2, u)
    for j in range(k):
        V[k, j] = V[k + 1, j] = 0.0
    V[k, k], V[k + 1, k], V[k + 1, k + 1] = v1, 0.0, v2


@inlined
def _prior_rows(b: Batch, R: Array, t: Array, r: Array, J: Array, V: Array) -> int:
    """Fill a prior pose as six whitened rows: W (delta), first order in the rotation."""
    x = rotation_vector(R, b.prior_r)
    for k in range(6):
        s = 0.0
        for j in range(3):
            s += b.prior_w[k, j] * (t[j] - b.prior_t[j]) + b.prior_w[k, 3 + j] * x[j]
        r[k] = s
        for j in range(6):
            J[k, j] = b.prior_w[k, j]
            V[k, j] = 1.0 if j == k else 0.0
    return 6


@compiled
def whitened(b: Batch, i: int, R: Array, t: Array, far: bool, r: Array, J: Array, V: Array) -> int:
    """Fill the rows as `rows` does, with r and J divided by the root of the covariance, so that f = |r|^2."""
    k = rows(b, i, R, t, far, r, J, V)
    if b.cls[i] == 0:
        return k
    if not cholesky(V, k):
        return 0
    solve_lower(V, r, k)
    for j in range(6):
        for row in range(k):
            s = J[row, j]
            for c in range(row):
                s -= V[row, c] * J[c, j]
            J[row, j] = s / V[row, row]
    return k


@compiled
def values(b: Batch, R: Array, t: Array, far: bool, f: Array) -> None:
    """Compute first-order local pose functions f (N,) at a pose."""
    r, J, V = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    for i in range(b.cls.size):
        k = rows(b, i, R, t, far, r, J, V)
        s = 0.0
        if b.cls[i] == 0:
            for j in range(k):
                s += r[j] * r[j]
        elif cholesky(V, k):
            solve_lower(V, r, k)
            for j in range(k):
                s += r[j] * r[j]
        f[i] = s


@compiled
def log_volumes(b: Batch, R: Array, t: Array, out: Array) -> None:
    """Compute out (N,) = log sqrt det(2 pi V_i), the log volume (m, rad) of an inlier's residual; 0 for a prior."""
    r, J, V = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    for i in range(b.cls.size):
        out[i] = 0.0
        k = rows(b, i, R, t, NEAR, r, J, V)
        if b.cls[i] != 0 and cholesky(V, k):
            for j in range(k):
                out[i] += min(0.0, math.log(V[j, j]) + HALF_LOG_2PI)


@compiled
def whitened_all(b: Batch, R: Array, t: Array, r: Array, J: Array) -> None:
    """Compute whitened residuals r (N, 6) and Jacobians J (N, 6, 6) of every entry, zero beyond its own rows."""
    own_r, own_j, V = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    r[:], J[:] = 0.0, 0.0
    for i in range(b.cls.size):
        n = whitened(b, i, R, t, NEAR, own_r, own_j, V)
        for k in range(n):
            r[i, k] = own_r[k]
            for c in range(6):
                J[i, k, c] = own_j[k, c]
