"""Small dense algebra against numpy, as plain Python and compiled."""

from __future__ import annotations

import numpy as np
import pytest

from hal.arrays import Array
from hal.small_algebra import factor, put1, put2, solve_lower, solve_positive, solve_upper


def positive(n: int, seed: int) -> Array:
    rows = np.random.default_rng(seed).normal(size=(3 * n, n))
    return rows.T @ rows


@pytest.mark.parametrize("n", [1, 3, 6, 9])
def test_a_system_is_solved_as_numpy_does(n: int) -> None:
    A, b = positive(n, n), np.arange(1.0, n + 1)
    work, x = A.copy(), b.copy()
    assert solve_positive(work, x, n)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9)
    np.testing.assert_allclose(np.tril(work), np.linalg.cholesky(A), rtol=1e-9, atol=1e-12)


def test_only_the_leading_block_and_the_lower_triangle_are_read() -> None:
    A = positive(4, 1)
    garbled = np.where(np.tri(4, dtype=bool), A, np.nan)
    garbled[3] = np.nan
    b = np.ones(4)
    assert solve_positive(garbled, b, 3)
    np.testing.assert_allclose(b[:3], np.linalg.solve(A[:3, :3], np.ones(3)), rtol=1e-9)
    assert b[3] == 1.0


def test_the_two_halves_undo_their_triangles() -> None:
    L = np.linalg.cholesky(positive(5, 2))
    b = np.arange(5.0)
    lower, upper = b.copy(), b.copy()
    solve_lower(L, lower, 5)
    solve_upper(L, upper, 5)
    np.testing.assert_allclose(L @ lower, b, atol=1e-12)
    np.testing.assert_allclose(L.T @ upper, b, atol=1e-12)


@pytest.mark.parametrize("bad", [np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_matrix_that_is_not_positive_definite_has_no_factor(bad: Array) -> None:
    assert not factor(bad, bad, 0.0, 0.0, 1e-13, np.zeros((2, 2)), 2)


def test_copies_fill_the_leading_part() -> None:
    vector, matrix = np.zeros(4), np.zeros((4, 4))
    put1(vector, np.ones(3))
    put2(matrix, np.ones((3, 3)))
    assert vector.tolist() == [1.0, 1.0, 1.0, 0.0] and matrix.sum() == 9.0 and not matrix[3].any()
