"""Descent on the sum of squares of the whitened rows, compiled: from anywhere, or the last steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion.batch import Batch
from fusion.distance.rows import rows, whitened
from fusion.vectors import cholesky, move
from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.least_squares import DampingRule, minimise, solve_damped
from hal.small_algebra import put1, put2, solve_lower

RULE = DampingRule(start=1e-6, fall=0.1, rise=8.0, least=1e-9, restart=1e-6, most=1e8)
FAR_RULE = RULE._replace(start=1e-3)
FLOOR = 1e-12  # of the information, relative to its largest entry, because measurements may leave a motion free


@compiled
def accumulate(b: Batch, use: Array, R: Array, t: Array, far: bool, H: Array, g: Array, work: Array) -> float:
    """Compute H (6, 6) lower = sum J^T J, g (6,) = sum J^T r over entries with use > 0; returns sum |r|^2.

    work: (13, 6) scratch.
    """
    r, J, V = work[0], work[1:7], work[7:13]
    for j in range(6):
        g[j] = 0.0
        for k in range(6):
            H[j, k] = 0.0
    cost = 0.0
    for i in range(b.cls.size):
        if use[i] <= 0.0:
            continue
        n = whitened(b, i, R, t, far, r, J, V)
        for k in range(n):
            cost += r[k] * r[k]
            for p in range(6):
                g[p] += J[k, p] * r[k]
                for c in range(p + 1):
                    H[p, c] += J[k, p] * J[k, c]
    return cost


@compiled
def cost_of(b: Batch, use: Array, R: Array, t: Array, far: bool, work: Array) -> float:
    """Return sum |r|^2 over entries with use > 0."""
    r, J, V = work[0], work[1:7], work[7:13]
    cost = 0.0
    for i in range(b.cls.size):
        if use[i] <= 0.0:
            continue
        k = rows(b, i, R, t, far, r, J, V)
        if b.cls[i] != 0:
            if not cholesky(V, k):
                continue
            solve_lower(V, r, k)
        for j in range(k):
            cost += r[j] * r[j]
    return cost


class Problem(NamedTuple):
    """Measurements, which of them to use (N,), whether the pose may be far from them, and scratch."""

    b: Batch
    use: Array
    far: bool
    L: Array
    work: Array


class Point(NamedTuple):
    """Pose R (3, 3), t (3,); information H (6, 6), lower, gradient g (6,) and step (6,) there."""

    R: Array
    t: Array
    H: Array
    g: Array
    step: Array


@inlined
def solve(problem: Problem, at: Point, damping: float) -> float:
    """Write the damped step into `at` and return the predicted decrease; -1 where there is no step."""
    size = 0.0
    for j in range(6):
        size = max(size, at.H[j, j])
        at.step[j] = -at.g[j]
    fall = solve_damped(at.H, at.H, damping, FLOOR * size, 0.0, at.step, problem.L, 6)
    turn = at.step[3] ** 2 + at.step[4] ** 2 + at.step[5] ** 2
    if fall >= 0.0 and turn > 1.0:  # the linearisation is not valid beyond a radian
        for j in range(6):
            at.step[j] /= turn**0.5
    return fall


@inlined
def move_into(problem: Problem, at: Point, trial: Point) -> None:  # noqa: ARG001  # `minimise` passes it
    """Write the pose after the step of `at` into `trial`."""
    put1(trial.t, at.t)
    put2(trial.R, at.R)
    move(trial.R, trial.t, at.step)


@inlined
def evaluate(problem: Problem, at: Point, is_last: bool) -> float:
    """Return the cost at a pose and write its information and gradient, which nobody needs after the last step."""
    if is_last:
        return cost_of(problem.b, problem.use, at.R, at.t, problem.far, problem.work)
    return accumulate(problem.b, problem.use, at.R, at.t, problem.far, at.H, at.g, problem.work)


@inlined
def accept(problem: Problem, at: Point, trial: Point, is_last: bool) -> None:  # noqa: ARG001  # copying is cheap
    """Copy `trial` into `at`."""
    put2(at.R, trial.R)
    put1(at.t, trial.t)
    put2(at.H, trial.H)
    put1(at.g, trial.g)


@compiled
def descend(b: Batch, use: Array, R: Array, t: Array, far: bool, steps: int, tolerance: float) -> float:
    """Minimise sum |r|^2 over entries with use > 0 by Levenberg-Marquardt, moving R, t in place; returns the cost.

    The step is damped in proportion to the diagonal of J^T J (Marquardt), so metres and radians need no common scale.
    It stops when the predicted decrease is below `tolerance`.
    """
    problem = Problem(b, use, far, np.empty((6, 6)), np.empty((13, 6)))
    at = Point(R, t, np.empty((6, 6)), np.empty(6), np.empty(6))
    trial = Point(np.empty((3, 3)), np.empty(3), np.empty((6, 6)), np.empty(6), np.empty(6))
    cost = evaluate(problem, at, False)
    rule = FAR_RULE if far else RULE
    cost, _ = minimise(solve, move_into, evaluate, accept, problem, at, trial, cost, rule, steps, tolerance)
    return cost
