"""Minimises a sum of squares by Levenberg-Marquardt steps and refuses problems that the data do not determine.

Residuals are whitened by their covariance, so that the sum is a chi-square and the inverse of J^T J is a covariance.
Loops that run thousands of times per second do not use this module; they are compiled together with their residuals.

Source: D. W. Marquardt, J. SIAM 11(2), 1963: the damping is scaled by the diagonal of J^T J, divided by ten after a
step that reduces the sum, and multiplied by ten after one that does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hal.arrays import Array
from hal.errors import NotObservable

S = TypeVar("S")

STEPS = 60
CONVERGED = 1e-10  # decrease of chi-square in one step, relative to 1 + chi-square


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
            damping = max(damping / 10.0, 1e-12)
            if fall < CONVERGED * (1.0 + float(residual @ residual)):
                break
        else:
            damping *= 10.0
            if damping > 1e8:
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
