"""Compiled inner loops of the pose of four points: reprojection chi-square, its derivatives and a local minimiser.

Points in the image are normalised coordinates `m` (4, 2) with information `A` (4, 3) = (a_uu, a_uv, a_vv) each; object
points are `X` (4, 3), with the origin at their centroid. A pose is `R` (3, 3) and `t` (3,), camera_from_object.
Perturbations are ordered translation, then rotation: t <- t + d, R <- Exp(w) R. Costs are chi-squares.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.least_squares import DampingRule, minimise, solve_damped
from hal.small_algebra import put1, put2
from perception.vision.quadrangle.small_vectors import cross3, mix3, product3

CONVERGED = 1e-9  # predicted decrease of chi-square at which to stop: 3e-5 of a standard deviation
MAX_STEPS = 2000  # of usually 5; with 60, one view in 170 ends in a valley and counts as a minimum that it is not
RULE = DampingRule(start=1e-4, fall=0.1, rise=8.0, least=0.0, restart=1e-4, most=1e12)
LEAST_PIVOT = 1e-14  # relative to the Gauss-Newton matrix; below it the matrix counts as singular


@inlined
def rotation_of(w: Array) -> Array:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    s = 1.0 - angle2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    c = 0.5 - angle2 / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / angle2
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = c * w[i] * w[j]
        R[i, i] += 1.0 - c * angle2
    R[0, 1] -= s * w[2]
    R[1, 0] += s * w[2]
    R[0, 2] += s * w[1]
    R[2, 0] -= s * w[1]
    R[1, 2] -= s * w[0]
    R[2, 1] += s * w[0]
    return R


@inlined
def turn_onto(a: Array, b: Array) -> Array:
    """Return the smallest rotation that turns unit vector a onto unit vector b, which must not be opposite to a."""
    v = cross3(a, b)
    c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    k = 1.0 / (1.0 + c)
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = k * v[i] * v[j]
        R[i, i] += c
    R[0, 1] -= v[2]
    R[1, 0] += v[2]
    R[0, 2] += v[1]
    R[2, 0] -= v[1]
    R[1, 2] -= v[0]
    R[2, 1] += v[0]
    return R


@compiled
def chi_square(R: Array, t: Array, X: Array, m: Array, A: Array) -> float:
    """Return the reprojection chi-square of a pose; infinite if a point is behind the camera."""
    total = 0.0
    for i in range(X.shape[0]):
        z = R[2, 0] * X[i, 0] + R[2, 1] * X[i, 1] + R[2, 2] * X[i, 2] + t[2]
        if not z > 0.0:
            return np.inf
        eu = (R[0, 0] * X[i, 0] + R[0, 1] * X[i, 1] + R[0, 2] * X[i, 2] + t[0]) / z - m[i, 0]
        ev = (R[1, 0] * X[i, 0] + R[1, 1] * X[i, 1] + R[1, 2] * X[i, 2] + t[1]) / z - m[i, 1]
        total += A[i, 0] * eu * eu + 2.0 * A[i, 1] * eu * ev + A[i, 2] * ev * ev
    return total


@compiled
def expand(R: Array, t: Array, X: Array, m: Array, A: Array, g: Array, N: Array) -> float:
    """Return the chi-square; fills half its gradient g (6,) with respect to the pose, and its Gauss-Newton matrix N (6, 6)."""
    for a in range(6):
        g[a] = 0.0
        for b in range(6):
            N[a, b] = 0.0
    Ju = np.empty(6)
    Jv = np.empty(6)
    total = 0.0
    for i in range(X.shape[0]):
        y0 = R[0, 0] * X[i, 0] + R[0, 1] * X[i, 1] + R[0, 2] * X[i, 2]
        y1 = R[1, 0] * X[i, 0] + R[1, 1] * X[i, 1] + R[1, 2] * X[i, 2]
        y2 = R[2, 0] * X[i, 0] + R[2, 1] * X[i, 1] + R[2, 2] * X[i, 2]
        z = y2 + t[2]
        if not z > 0.0:
            return np.inf
        iz = 1.0 / z
        u = (y0 + t[0]) * iz
        v = (y1 + t[1]) * iz
        eu = u - m[i, 0]
        ev = v - m[i, 1]
        lu = A[i, 0] * eu + A[i, 1] * ev
        lv = A[i, 1] * eu + A[i, 2] * ev
        total += lu * eu + lv * ev
        # du/dq = (1, 0, -u)/z, dv/dq = (0, 1, -v)/z; a . (w x y) = w . (y x a)
        Ju[0] = iz
        Ju[1] = 0.0
        Ju[2] = -u * iz
        Ju[3] = y1 * Ju[2]
        Ju[4] = y2 * iz - y0 * Ju[2]
        Ju[5] = -y1 * iz
        Jv[0] = 0.0
        Jv[1] = iz
        Jv[2] = -v * iz
        Jv[3] = y1 * Jv[2] - y2 * iz
        Jv[4] = -y0 * Jv[2]
        Jv[5] = y0 * iz
        for a in range(6):
            g[a] += lu * Ju[a] + lv * Jv[a]
            pu = A[i, 0] * Ju[a] + A[i, 1] * Jv[a]
            pv = A[i, 1] * Ju[a] + A[i, 2] * Jv[a]
            for b in range(a + 1):
                N[a, b] += pu * Ju[b] + pv * Jv[b]
    for a in range(6):
        for b in range(a + 1):
            N[b, a] = N[a, b]
    return total


class Problem(NamedTuple):
    """Object points X (4, 3), image points m (4, 2), their information A (4, 3), and scratch for a factor (6, 6)."""

    X: Array
    m: Array
    A: Array
    L: Array


class Point(NamedTuple):
    """Pose R (3, 3), t (3,); `expand`'s derivatives g, N and the step x (6,) there. A trial pose has none of its own."""

    R: Array
    t: Array
    g: Array
    N: Array
    x: Array


@inlined
def solve(problem: Problem, at: Point, damping: float) -> float:
    """Write the damped Gauss-Newton step into `at` and return the predicted decrease; -1 where there is no step."""
    for i in range(6):
        at.x[i] = -at.g[i]
    return solve_damped(at.N, at.N, damping, 0.0, LEAST_PIVOT, at.x, problem.L, 6)


@inlined
def move(problem: Problem, at: Point, trial: Point) -> None:  # noqa: ARG001  # `minimise` passes it
    """Write the pose after the step of `at` into `trial`."""
    put2(trial.R, product3(rotation_of(at.x[3:]), at.R))
    put1(trial.t, mix3(1.0, at.t, 1.0, at.x))


@inlined
def evaluate(problem: Problem, at: Point, is_last: bool) -> float:  # noqa: ARG001  # the derivatives follow in `accept`
    """Return chi-square at a pose."""
    return chi_square(at.R, at.t, problem.X, problem.m, problem.A)


@inlined
def accept(problem: Problem, at: Point, trial: Point, is_last: bool) -> None:
    """Move `at` to `trial` and write the derivatives there, which a last step hardly changes."""
    put2(at.R, trial.R)
    put1(at.t, trial.t)
    if not is_last:
        expand(at.R, at.t, problem.X, problem.m, problem.A, at.g, at.N)


@compiled
def find_minimum(R: Array, t: Array, X: Array, m: Array, A: Array) -> tuple[Array, Array, float, Array]:
    """Find the local minimum of chi-square near a start by damped Gauss-Newton steps.

    Returns: R, t, chi-square (infinite if the start is behind the camera), Gauss-Newton matrix (6, 6).
    """
    g, x, N, L = np.empty(6), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    cost = expand(R, t, X, m, A, g, N)
    if not np.isfinite(cost):
        return R, t, np.inf, N
    at, trial = Point(R.copy(), t.copy(), g, N, x), Point(np.empty((3, 3)), np.empty(3), g, N, x)
    problem = Problem(X, m, A, L)
    cost, _ = minimise(solve, move, evaluate, accept, problem, at, trial, cost, RULE, MAX_STEPS, CONVERGED)
    return at.R, at.t, cost, N
