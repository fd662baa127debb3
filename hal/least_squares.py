"""Minimises a sum of squares by Levenberg-Marquardt steps and refuses problems that the data do not determine.

Residuals are whitened by their covariance, so that the sum is a chi-square and the inverse of J^T J is a covariance.

`minimise` is the only such loop of the project. `descend` runs it in Python for any residuals. Problems that are solved
thousands of times per second (`fusion.solve.descent`, `perception.vision.quadrangle`, `perception.range.fitting`) run it
compiled together with their residuals: numba copies it into a compiled function that calls it.

Source: D. W. Marquardt, J. SIAM 11(2), 1963: the damping is scaled by the diagonal of J^T J, falls after a step that
reduces the sum, and rises after one that does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from hal.arrays import Array
from hal.errors import NotObservable
from hal.jit import inlined
from hal.small_algebra import factor, solve_lower, solve_upper

P = TypeVar("P")
S = TypeVar("S")
T = TypeVar("T")

STEPS = 60
CONVERGED = 1e-10  # expected decrease of chi-square in one step, relative to 1 + chi-square


class DampingRule(NamedTuple):
    """How the damping follows from whether a step has reduced the sum of squares.

    Attributes:
        start: damping of the first step.
        fall, rise: factors after a step that reduces the sum, and after one that does not.
        least: it does not fall below this.
        restart: it rises at least to this.
        most: the descent ends above this.
        stuck: the descent also ends after a step that does not reduce the sum and whose expected gain was below this
            multiple of the negligible one.
    """

    start: float
    fall: float
    rise: float
    least: float
    restart: float
    most: float
    stuck: float = 1.0


RULE = DampingRule(start=1e-6, fall=0.1, rise=10.0, least=1e-12, restart=0.0, most=1e8)


@inlined
def next_damping(damping: float, is_lower: bool, rule: DampingRule) -> float:
    """Return the damping of the next step; the descent ends when it exceeds `rule.most`."""
    if is_lower:
        return max(damping * rule.fall, rule.least)
    return max(damping * rule.rise, rule.restart)


@inlined(early=True)
def minimise(
    solve: Callable[[P, S, float], float], move: Callable[[P, S, S], None], evaluate: Callable[[P, S, bool], float],
    accept: Callable[[P, S, S, bool], None], problem: P, at: S, trial: S, cost: float,
    rule: DampingRule, steps: int, negligible: float,
) -> tuple[float, bool]:  # fmt: skip
    """Reduce a sum of squares by at most `steps` damped steps, which move the point `at`.

    A point holds a state, the linear system there and the step from there.

    Args:
        solve: writes the step that the given damping allows into the point and returns its expected gain, in any measure;
            -1 where there is no step.
        move: writes the state after the step of the first point into the second.
        evaluate: returns the sum of squares at a point. It may write the linear system there.
        accept: copies the second point into the first, which then needs the linear system. For both, the last argument
            tells that no step follows, so that the system may be left out.
        problem: data that the three functions need.
        at: the start, evaluated; afterwards the point with the smallest sum. `trial`: storage for a second point.
        cost: sum of squares at the start.
        negligible: the descent ends with a step whose expected gain is below this.

    Returns:
        the smallest sum, and whether it is that of the point that was evaluated last.
    """
    damping, is_lower = rule.start, True
    for turn in range(steps):
        gain = solve(problem, at, damping)
        if gain < 0.0:
            damping = next_damping(damping, False, rule)
            if damping > rule.most:
                break
            continue
        move(problem, at, trial)
        is_last = turn + 1 == steps or gain < negligible
        trial_cost = evaluate(problem, trial, is_last)
        is_lower = trial_cost <= cost
        if is_lower:
            accept(problem, at, trial, is_last)
            cost = trial_cost
            if is_last:
                break
        elif gain < rule.stuck * negligible:
            break
        damping = next_damping(damping, is_lower, rule)
        if damping > rule.most:
            break
    return cost, is_lower


@inlined
def solve_damped(A: Array, D: Array, damping: float, floor: float, least: float, b: Array, L: Array, n: int) -> float:
    """Solve (A + damping diag(D) + floor I) x = b, overwrite `b` (n,) with x and return the predicted decrease b^T x.

    Only the lower triangles of A and D (n, n) are read; `L` (n, n) receives the Cholesky factor. Returns -1 when a
    pivot is not above `least` times the entry of D, so that there is no step.
    """
    if not factor(A, D, damping, floor, least, L, n):
        return -1.0
    solve_lower(L, b, n)
    fall = 0.0
    for i in range(n):
        fall += b[i] * b[i]
    solve_upper(L, b, n)
    return fall


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minimum:
    """Minimum of a sum of squares: chi-square, the information matrix (n, n) and its inverse, the covariance."""

    chi_square: float
    information: Array
    covariance: Array


class _Point(Generic[T]):
    """State, whitened residual, Jacobian, and the step from there."""

    def __init__(self, state: T) -> None:
        self.state = state
        self.residual = self.jacobian = self.step = np.empty(0)


def descend(
    state: T, linearise: Callable[[T], tuple[Array, Array]], move: Callable[[T, Array], T]
) -> tuple[T, Minimum]:
    """Return the state that minimises |residual|^2, with chi-square and covariance there.

    Args:
        state: initial state.
        linearise: returns the whitened residual (m,) and the Jacobian (m, n) at a state.
        move: returns the state after a step (n,).

    Raises:
        NotObservable: the residuals do not depend on some direction of the state.
    """

    def evaluate(_: None, point: _Point[T], is_last: bool) -> float:  # noqa: ARG001  # the system gives the covariance
        point.residual, point.jacobian = linearise(point.state)
        return float(point.residual @ point.residual)

    def solve(_: None, point: _Point[T], damping: float) -> float:
        information, gradient = point.jacobian.T @ point.jacobian, point.jacobian.T @ point.residual
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information / np.outer(scale, scale) + damping * np.eye(len(scale))
        point.step = -np.linalg.lstsq(scaled, gradient / scale, rcond=None)[0] / scale
        return max(float(-gradient @ point.step), 0.0) / (1.0 + float(point.residual @ point.residual))

    def write_moved(_: None, point: _Point[T], into: _Point[T]) -> None:
        into.state = move(point.state, point.step)

    def accept(_: None, at: _Point[T], trial: _Point[T], is_last: bool) -> None:  # noqa: ARG001  # copying is cheap
        at.state, at.residual, at.jacobian = trial.state, trial.residual, trial.jacobian

    at = _Point(state)
    cost = evaluate(None, at, False)
    cost, _ = minimise(solve, write_moved, evaluate, accept, None, at, _Point(state), cost, RULE, STEPS, CONVERGED)
    information = at.jacobian.T @ at.jacobian
    return at.state, Minimum(chi_square=cost, information=information, covariance=invert(information))


def invert(information: Array) -> Array:
    """Return the inverse of an information matrix, whose diagonal is scaled to 1 for the computation.

    Raises:
        NotObservable: the matrix is singular; `details["direction"]` holds the undetermined direction.
    """
    diagonal = np.diag(information)
    if not (np.isfinite(information).all() and (diagonal > 0).all()):
        raise NotObservable(
            "the data do not depend on one of the parameters, so it cannot be determined", hint="add views that differ more",
            direction=[float(d <= 0) for d in diagonal],
        )  # fmt: skip
    scale = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] < 1e-12 * values[-1]:
        direction = vectors[:, 0] / scale
        raise NotObservable(
            "the data do not determine one combination of the parameters", hint="add views that differ more",
            direction=(direction / np.abs(direction).max()).round(3).tolist(),
        )  # fmt: skip
    return np.asarray((vectors / values) @ vectors.T / np.outer(scale, scale))
