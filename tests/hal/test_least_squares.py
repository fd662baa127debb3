"""Compares the damped solver with scipy's, and tests what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from hal.arrays import Array
from hal.errors import NotObservable
from hal.least_squares import descend, invert

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
