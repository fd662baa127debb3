"""Slow and simple versions of the fast loops, to check them: brute force, and the table of residuals in numpy.

Nothing here shares code with `exact`, `rows` or `fusion.solve.polish`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform

from fusion.measurement import Measurement, SensingClass
from hal.arrays import Array
from hal.geometry import matrix_of

SPHERE = 1500  # directions of the initial search
REFINED = 3


def brute_force(m: Measurement, base_from_object: RigidTransform) -> float:
    """Return the local pose function by search: the minimum over allowed directions v of position cost plus v^T M v.

    For a given v the allowed positions are a line or a plane, and the nearest one in C's metric is a linear problem.
    """
    R = matrix_of(base_from_object)
    e, u = R @ m.x_m + base_from_object.translation - m.mu_m, R @ m.u
    if m.cls <= 3:
        return _nearest(m, e, u)
    if m.cls in (SensingClass.LINE_LINE, SensingClass.PLANE_PLANE):
        return _nearest(m, e, u) + float(tilt(m.M, u[None])[0])
    basis = np.eye(3) if m.cls in (SensingClass.LINE_POINT, SensingClass.PLANE_POINT) else _across(u)
    fixed = _nearest(m, e, u) if m.cls == SensingClass.LINE_PLANE else None
    A = np.linalg.inv(m.C_m2)

    def share(v: Array) -> Array:
        """Return the position cost for rows of unit directions v (k, 3)."""
        if fixed is not None:
            return np.full(len(v), fixed)
        if m.cls == SensingClass.LINE_POINT:
            y = e - ((v @ A @ e) / np.einsum("ki,ij,kj->k", v, A, v))[:, None] * v
            return np.asarray(np.einsum("ki,ij,kj->k", y, A, y))
        return np.asarray((v @ e) ** 2 / np.einsum("ki,ij,kj->k", v, m.C_m2, v))

    def f(x: Array) -> Array:
        v = np.atleast_2d(x) @ basis.T
        v = v / np.linalg.norm(v, axis=1)[:, None]
        return np.asarray(share(v) + tilt(m.M, v))

    looks = _directions(basis.shape[1])
    best = looks[np.argsort(f(looks))[:REFINED]]
    # The cost has narrow valleys at the measured direction and where only one of its two parts matters.
    d = np.linalg.eigh(m.M)[1][:, 0]
    narrow = [d, e, *_across(e).T, d - e * (d @ e) / max(e @ e, 1e-300)]
    starts = [*best, *(basis.T @ v for v in narrow if np.linalg.norm(basis.T @ v) > 1e-9)]
    return min(_descended(lambda x: float(f(x)[0]), s) for s in starts)


def tilt(M: Array, v: Array) -> Array:
    """Return v^T M v for rows of v (k, 3), computed as a sum of squares.

    The plain product would lose values below 1e-16 of M's largest entry.
    """
    values, vectors = np.linalg.eigh(M)
    return np.asarray((v @ vectors) ** 2 @ values)


def _descended(f: Callable[[Array], float], start: Array) -> float:
    """Minimise by restarted Nelder-Mead, whose lack of derivatives excludes errors in common with the fast code."""
    x = start / np.linalg.norm(start)
    for size in (0.03, 1e-4, 1e-7):
        simplex = np.vstack([x, x + size * np.eye(len(x))])
        found = minimize(f, x, method="Nelder-Mead",
                         options={"initial_simplex": simplex, "xatol": 1e-15, "fatol": 1e-15, "maxiter": 120})  # fmt: skip
        x = found.x / np.linalg.norm(found.x)
    return float(found.fun)


def _nearest(m: Measurement, e: Array, u: Array) -> float:
    """Return min over y of (y - mu)^T C^-1 (y - mu), x - mu = e, for the classes whose positions do not depend on v."""
    A = np.linalg.inv(m.C_m2)
    free = {1: np.empty((3, 0)), 2: u[:, None], 5: u[:, None], 3: _across(u), 6: _across(u), 9: _across(u)}[int(m.cls)]
    y: Array = e
    if free.shape[1]:
        y = np.asarray(e - free @ np.linalg.solve(free.T @ A @ free, free.T @ A @ e), np.float64)
    return float(y @ A @ y)


def _across(u: Array) -> Array:
    """Return a (3, 2) orthonormal basis perpendicular to u."""
    return np.asarray(np.linalg.svd(u[None])[2][1:].T)


def _directions(dimension: int) -> Array:
    """Return unit vectors spread over half a circle or half a sphere (Fibonacci)."""
    k = np.arange(SPHERE) + 0.5
    if dimension == 2:
        angle = np.pi * k / SPHERE
        return np.column_stack([np.cos(angle), np.sin(angle)])
    z, spiral = k / SPHERE, np.pi * (1 + 5**0.5) * k
    rho = np.sqrt(1 - z**2)
    return np.column_stack([rho * np.cos(spiral), rho * np.sin(spiral), z])


def residual(m: Measurement, R: Array, t: Array) -> Array:
    """Return the whitened first-order residuals of one measurement at a pose, (1 to 4,); their squared norm is f."""
    e, u, C = R @ m.x_m + t - m.mu_m, R @ m.u, m.C_m2
    if m.cls == SensingClass.POINT_POINT:
        return _white(e, C)
    N = _across(u)
    if m.cls == SensingClass.POINT_LINE:
        return _white(N.T @ e, N.T @ C @ N)
    first, first_variance = np.array([u @ e]), np.array([[u @ C @ u]])
    if m.cls == SensingClass.POINT_PLANE:
        return _white(first, first_variance)
    values, vectors = np.linalg.eigh(m.M)
    d, E, S2 = vectors[:, 0], vectors[:, 1:], np.diag(1 / values[1:])
    S = E @ S2 @ E.T
    offset = np.array([[d @ C @ d + e @ S @ e]])
    if m.cls == SensingClass.LINE_POINT:
        return _white(E.T @ e, E.T @ C @ E + (d @ e) ** 2 * S2)
    if m.cls == SensingClass.LINE_LINE:
        return np.concatenate([_white(N.T @ e, N.T @ C @ N), _white(E.T @ u, S2)])
    if m.cls == SensingClass.LINE_PLANE:
        return np.concatenate([_white(first, first_variance), _white(np.array([d @ u]), np.array([[u @ S @ u]]))])
    if m.cls == SensingClass.PLANE_POINT:
        return _white(np.array([d @ e]), offset)
    if m.cls == SensingClass.PLANE_LINE:
        V = np.array([[offset[0, 0], e @ S @ u], [e @ S @ u, u @ S @ u]])
        return _white(np.array([d @ e, d @ u]), V)
    return np.concatenate([_white(first, first_variance), _white(E.T @ u, S2)])


def _white(r: Array, V: Array) -> Array:
    return np.asarray(np.linalg.solve(np.linalg.cholesky(V), r))
