"""Compares the damped solver with scipy's, and tests what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from hal.arrays import Array
from hal.errors import NotObservable
from hal.least_squares import DampingRule, descend, invert, next_damping, solve_damped

TIMES_S = np.linspace(0.0, 3.0, 20)
SEEN = 2.0 * np.exp(-0.7 * TIMES_S) + 0.3 + 0.01 * np.random.default_rng(1).normal(size=20)


def linearised(x: Array) -> tuple[Array, Array]:
    """Exponential decay with an offset: three parameters of very different sensitivity."""
    decay = np.exp(-x[1] * TIMES_S)
    residual = (x[0] * decay + x[2] - SEEN) / 0.01
    return residual, np.column_stack([decay, -x[0] * TIMES_S * decay, np.ones(20)]) / 0.01


def test_the_minimum_is_scipys_and_its_covariance_that_of_the_normal_equations() -> None:
    found, minimum = descend(np.array([0.5, 3.0, 0.0]), linearised, lambda x, step: x + step)
    theirs = least_squares(lambda x: linearised(x)[0], [0.5, 3.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found, theirs.x, rtol=1e-6)
    assert minimum.chi_square == pytest.approx(2.0 * theirs.cost, rel=1e-9)
    jacobian = linearised(found)[1]
    np.testing.assert_allclose(minimum.covariance, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-6)


def test_a_parameter_that_does_not_show_is_refused() -> None:
    with pytest.raises(NotObservable, match="do not depend on one of the parameters"):
        descend(np.zeros(2), lambda x: (x[:1] - 1.0, np.array([[1.0, 0.0]])), lambda x, step: x + step)


def test_a_combination_that_stays_free_is_named() -> None:
    with pytest.raises(NotObservable) as refused:
        invert(np.array([[1.0, 1.0], [1.0, 1.0]]))
    assert refused.value.details["direction"] in ([1.0, -1.0], [-1.0, 1.0])


def test_a_damped_step_is_numpys_and_its_predicted_decrease_that_of_the_quadratic_model() -> None:
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(12, 6))
    A, b, L = rows.T @ rows, rng.normal(size=6), np.zeros((6, 6))
    x = b.copy()
    fall = solve_damped(np.tril(A), np.tril(A), 0.3, 0.01, 1e-13, x, L, 6)
    damped = A + 0.3 * np.diag(np.diag(A)) + 0.01 * np.eye(6)
    np.testing.assert_allclose(x, np.linalg.solve(damped, b), rtol=1e-10)
    np.testing.assert_allclose(L, np.linalg.cholesky(damped), atol=1e-12)
    assert fall == pytest.approx(b @ np.linalg.solve(damped, b))


def test_there_is_no_step_where_the_matrix_is_not_positive_definite() -> None:
    b = np.array([1.0, 2.0])
    assert solve_damped(np.diag([1.0, -1.0]), np.eye(2), 0.5, 0.0, 1e-13, b, np.zeros((2, 2)), 2) == -1.0
    assert b.tolist() == [1.0, 2.0]


def test_the_damping_falls_to_its_least_value_and_rises_at_once_to_where_it_matters() -> None:
    rule = DampingRule(start=1e-4, fall=0.1, rise=8.0, least=1e-9, restart=1e-6, most=1e8)
    assert next_damping(1e-3, True, rule) == pytest.approx(1e-4)
    assert next_damping(1e-9, True, rule) == 1e-9
    assert next_damping(1e-9, False, rule) == 1e-6
    assert next_damping(1.0, False, rule) == 8.0
