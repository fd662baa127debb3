"""Minimises a sum of squares by Levenberg-Marquardt steps and refuses problems that the data do not determine.

Residuals are whitened by their covariance, so that the sum is a chi-square and the inverse of J^T J is a covariance.

`descend` minimises any residuals. The loops that run thousands of times per second are compiled together with their
residuals: those of `fusion.solve.descent`, `perception.vision.quadrangle` and `perception.range.fitting`. They differ in
how they linearise and move, and share the rule of the damping, `next_damping`; the first two also share the step,
`solve_damped`.

Source: D. W. Marquardt, J. SIAM 11(2), 1963: the damping is scaled by the diagonal of J^T J, falls after a step that
reduces the sum, and rises after one that does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from hal.arrays import Array
from hal.errors import NotObservable
from hal.jit import inlined
from hal.small_algebra import factor, solve_lower, solve_upper

S = TypeVar("S")

STEPS = 60
CONVERGED = 1e-10  # decrease of chi-square in one step, relative to 1 + chi-square


class DampingRule(NamedTuple):
    """How the damping follows from whether a step has reduced the sum of squares.

    Attributes:
        fall, rise: factors after a step that reduces the sum, and after one that does not.
        least: it does not fall below this.
        restart: it rises at least to this.
        most: the descent ends above this.
    """

    fall: float
    rise: float
    least: float
    restart: float
    most: float


RULE = DampingRule(fall=0.1, rise=10.0, least=1e-12, restart=0.0, most=1e8)


@inlined
def next_damping(damping: float, is_lower: bool, rule: DampingRule) -> float:
    """Return the damping of the next step; the descent ends when it exceeds `rule.most`."""
    if is_lower:
        return max(damping * rule.fall, rule.least)
    return max(damping * rule.rise, rule.restart)


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


def descend(
    state: S, linearise: Callable[[S], tuple[Array, Array]], move: Callable[[S, Array], S]
) -> tuple[S, Minimum]:
    """Return the state that minimises |residual|^2, with chi-square and covariance there.

    Args:
        state: initial state.
        linearise: returns the whitened residual (m,) and the Jacobian (m, n) at a state.
        move: returns the state after a step (n,).

    Raises:
        NotObservable: the residuals do not depend on some direction of the state.
    """
    residual, jacobian = linearise(state)
    damping = 1e-6
    for _ in range(STEPS):
        information, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information / np.outer(scale, scale) + damping * np.eye(len(scale))
        step = -np.linalg.lstsq(scaled, gradient / scale, rcond=None)[0] / scale
        candidate = move(state, step)
        new_residual, new_jacobian = linearise(candidate)
        if new_residual @ new_residual <= residual @ residual:
            fall = float(residual @ residual - new_residual @ new_residual)
            state, residual, jacobian = candidate, new_residual, new_jacobian
            damping = next_damping(damping, True, RULE)
            if fall < CONVERGED * (1.0 + float(residual @ residual)):
                break
        else:
            damping = next_damping(damping, False, RULE)
            if damping > RULE.most:
                break
    information = jacobian.T @ jacobian
    return state, Minimum(
        chi_square=float(residual @ residual), information=information, covariance=invert(information)
    )


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
