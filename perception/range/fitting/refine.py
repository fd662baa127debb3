"""Damped Gauss-Newton steps on the ray residuals of one surface (Levenberg's damping, Marquardt's scaling).

`fit` chooses initial parameters, weights and kinds; this module descends from there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hal.arrays import Array, Labels, Mask
from hal.jit import compiled, inlined
from hal.least_squares import DampingRule, minimise
from hal.small_algebra import put1, solve_positive
from perception.range.fitting.equations import normal_equations
from perception.range.fitting.rays import ERRED, LOADED, SCRATCH
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
    """Work arrays of a fit: the rows of `rays`, a factor (9, 9), two points, and residuals of many samples."""

    work: Array
    A: Array
    at: Point
    trial: Point
    errors: Array


class Problem(NamedTuple):
    """Samples, weights and scratch of one descent; see `refine`."""

    kind: int
    x: Array
    y: Array
    z: Array
    sigma: Array
    perspective: bool
    scale: float
    trim: float
    fixed: Mask
    held: int
    work: Array
    A: Array


@compiled
def new_scratch(samples: int) -> Scratch:
    """Allocate the work arrays of a fit to at most `samples` samples."""
    small = np.empty(3 * 81 + 4 * 9 + 2 * 6 + 2 * SIZE)  # one allocation instead of many
    H, H2, A = small[:81].reshape((9, 9)), small[81:162].reshape((9, 9)), small[162:243].reshape((9, 9))
    g, g2, step, step2 = small[243:252], small[252:261], small[261:270], small[270:279]
    frame, frame2, th, th2 = small[279:285], small[285:291], small[291 : 291 + SIZE], small[291 + SIZE :]
    used: Labels = np.zeros(2, np.int32)
    at, trial = Point(th, frame, H, g, step, used[:1]), Point(th2, frame2, H2, g2, step2, used[1:])
    return Scratch(np.empty(SCRATCH), A, at, trial, np.empty(samples))


@compiled
def refine(
    kind: int, th: Array, x: Array, y: Array, z: Array, sigma: Array, perspective: bool, steps: int, scale: float,
    trim: float, fixed: Mask, scratch: Scratch, held: int,
) -> tuple[float, int, int]:  # fmt: skip
    """Minimise the ray residuals with at most `steps` damped Gauss-Newton steps; updates the parameters `th` in place.

    Args:
        x, y, z, sigma: (N,) samples; coordinates as in `Grid`.
        scale: > 0: width of the Cauchy weights in sigmas; 0: trim at `trim` and plain least squares.
        fixed: (9,) bool, tangent parameters that stay at their prior value.
        held: which rows for these samples and `th` are valid in `scratch` (NOTHING, LOADED, ERRED or FILLED).

    Returns:
        cost, number of samples used, and which rows for the samples and the final `th` are valid in `scratch`.
    """
    at, work = scratch.at, scratch.work
    put1(at.th, th)
    frame_of(kind, th, at.frame)
    cost, at.used[0] = normal_equations(
        kind, th, at.frame, x, y, z, sigma, perspective, scale, trim, at.H, at.g, work, held, steps > 0
    )
    held = min(held, LOADED)
    problem = Problem(kind, x, y, z, sigma, perspective, scale, trim, fixed, held, work, scratch.A)
    cost, is_fresh = minimise(solve, move, evaluate, accept, problem, at, scratch.trial, cost, RULE, steps, STEP_GOAL)
    put1(th, at.th)
    return cost, int(at.used[0]), ERRED if is_fresh and held == LOADED else held


@inlined(early=True)
def solve(problem: Problem, at: Point, damping: float) -> float:
    """Write the damped step into `at`; returns its largest entry in standard deviations, -1 where there is no step."""
    p = FREEDOM[problem.kind]
    if not free_step(at.H, at.g, problem.fixed, damping, p, problem.A, at.step):
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
    cost, used = normal_equations(
        problem.kind, at.th, at.frame, problem.x, problem.y, problem.z, problem.sigma, problem.perspective,
        problem.scale, problem.trim, at.H, at.g, problem.work, problem.held, not is_last,
    )  # fmt: skip
    at.used[0] = used
    return cost if used >= FREEDOM[problem.kind] else np.inf


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


@compiled
def free_step(H: Array, g: Array, fixed: Mask, damping: float, p: int, A: Array, step: Array) -> bool:
    """Write the damped step of the free parameters into `step` (p,), zero for the `fixed` ones; `A` (p, p) is overwritten.

    `H` and `g` are the Gauss-Newton matrix and gradient. Returns False if the matrix is not positive definite. The damping
    multiplies the diagonal, because another order of rounding (`solve_damped` adds it) changes which surfaces of real
    images are merged.
    """
    for a in range(p):
        for b in range(a + 1):
            A[a, b] = 0.0 if fixed[a] or fixed[b] else H[a, b]
        A[a, a] = 1.0 if fixed[a] else A[a, a] * (1.0 + damping) + FLOOR
        step[a] = 0.0 if fixed[a] else g[a]
    return solve_positive(A, step, p)
