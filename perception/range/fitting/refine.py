"""Damped Gauss-Newton steps on the ray residuals of one surface (Levenberg's damping, Marquardt's scaling).

`fit` chooses initial parameters, weights and kinds; this module descends from there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import compiled, inlined
from hal.least_squares import DampingRule, minimise, solve_damped
from hal.small_algebra import LEAST_PIVOT, put1
from perception.range.fitting.equations import add_equations
from perception.range.fitting.rays import ERRED, FILLED, LOADED, SCRATCH, fill_rows, load_rows
from perception.range.fitting.surfaces import (
    FREEDOM,
    SIZE,
    frame_of,
    step_into,
)

# The damping falls slower than elsewhere, because a fit takes few steps and the weights change with the residuals.
RULE = DampingRule(start=1e-4, fall=0.2, rise=10.0, least=1e-9, restart=0.0, most=1e6, stuck=1.0 / 30.0)
FLOOR = 1e-12  # of the Gauss-Newton matrix
STEP_GOAL = 0.03  # in standard deviations of each parameter: a smaller step is the last one


class Point(NamedTuple):
    """Parameters of a surface and what belongs to them.

    These are the parameters `th`, their tangent `frame`, the Gauss-Newton matrix `H` (9, 9) and gradient `g` (9,), the
    `step` from there (9,), and the number of samples `used` (1,).
    """

    th: Array
    frame: Array
    H: Array
    g: Array
    step: Array
    used: Labels


class Scratch(NamedTuple):
    """Work arrays of a fit to some samples: the rows of `rays`, a factor (9, 9), and two points."""

    work: Array
    A: Array
    at: Point
    trial: Point


class Problem(NamedTuple):
    """Kind and number of samples, weights and scratch of one descent; see `refine`."""

    kind: int
    n: int
    perspective: bool
    scale: float
    work: Array
    A: Array


@compiled
def scratch_of(samples: Array) -> Scratch:
    """Allocate the work arrays of a fit, and load its samples (4, N) into them."""
    small = np.empty(3 * 81 + 4 * 9 + 2 * 6 + 2 * SIZE)  # one allocation instead of many
    H, H2, A = small[:81].reshape((9, 9)), small[81:162].reshape((9, 9)), small[162:243].reshape((9, 9))
    g, g2, step, step2 = small[243:252], small[252:261], small[261:270], small[270:279]
    frame, frame2, th, th2 = small[279:285], small[285:291], small[291 : 291 + SIZE], small[291 + SIZE :]
    used: Labels = np.zeros(2, np.int32)
    at, trial = Point(th, frame, H, g, step, used[:1]), Point(th2, frame2, H2, g2, step2, used[1:])
    work = np.empty(SCRATCH)
    load_rows(samples, work)
    return Scratch(work, A, at, trial)


@compiled
def refine(
    kind: int, th: Array, n: int, perspective: bool, steps: int, scale: float, scratch: Scratch, held: int,
) -> tuple[float, int, int]:  # fmt: skip
    """Minimise the ray residuals with at most `steps` damped Gauss-Newton steps; updates the parameters `th` in place.

    Args:
        n: number of samples, which `scratch` holds.
        scale: > 0: width of the Cauchy weights in sigmas; 0: trim and plain least squares.
        held: which rows for these samples and `th` are valid in `scratch` (LOADED, ERRED or FILLED).

    Returns:
        cost, number of samples used, and which rows for the samples and the final `th` are valid in `scratch`.
    """
    at = scratch.at
    put1(at.th, th)
    frame_of(kind, th, at.frame)
    problem = Problem(kind, n, perspective, scale, scratch.work, scratch.A)
    if held != FILLED:
        fill_rows(kind, th, at.frame, n, perspective, scratch.work)
    cost = linearise(problem, at, steps > 0)
    cost, is_fresh = minimise(solve, move, evaluate, accept, problem, at, scratch.trial, cost, RULE, steps, STEP_GOAL)
    put1(th, at.th)
    return cost, int(at.used[0]), ERRED if is_fresh else LOADED


@compiled
def linearise(problem: Problem, at: Point, step_follows: bool) -> float:
    """Write the system of the filled rows into `at`, if a step follows; returns the cost."""
    at.H[:] = 0.0
    at.g[:] = 0.0
    cost, used = add_equations(problem.kind, problem.n, problem.scale, problem.work, at.H, at.g, step_follows)
    at.used[0] = int(used)
    return cost


@inlined(early=True)
def solve(problem: Problem, at: Point, damping: float) -> float:
    """Write the damped step into `at`; returns its largest entry in standard deviations, -1 where there is no step."""
    p = FREEDOM[problem.kind]
    put1(at.step, at.g)
    if solve_damped(at.H, at.H, damping, FLOOR, LEAST_PIVOT, at.step, problem.A, p) < 0.0:
        return -1.0
    largest = 0.0
    for a in range(p):
        largest = max(largest, abs(at.step[a]) * np.sqrt(at.H[a, a]))
    return largest


@inlined(early=True)
def move(problem: Problem, at: Point, trial: Point) -> None:
    """Write the surface after the step of `at` into `trial`."""
    step_into(problem.kind, at.th, at.frame, at.step, trial.th)
    frame_of(problem.kind, trial.th, trial.frame)


@inlined(early=True)
def evaluate(problem: Problem, at: Point, is_last: bool) -> float:
    """Return the cost of a surface and write its equations; the cost is infinite where too few samples are used."""
    fill_rows(problem.kind, at.th, at.frame, problem.n, problem.perspective, problem.work)
    cost = linearise(problem, at, not is_last)
    return cost if at.used[0] >= FREEDOM[problem.kind] else np.inf


@inlined(early=True)
def accept(problem: Problem, at: Point, trial: Point, is_last: bool) -> None:
    """Copy `trial` into `at`, without the equations after the last step."""
    for i in range(SIZE):
        at.th[i] = trial.th[i]
    for i in range(6):
        at.frame[i] = trial.frame[i]
    at.used[0] = trial.used[0]
    if not is_last:
        for a in range(FREEDOM[problem.kind]):
            at.g[a] = trial.g[a]
            for b in range(FREEDOM[problem.kind]):
                at.H[a, b] = trial.H[a, b]
