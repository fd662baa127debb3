"""Dense algebra of small matrices for compiled loops: Cholesky factors of symmetric matrices, and copies.

A call to LAPACK for a 6x6 system takes longer than its solution. Only lower triangles are read and written. Copies are
loops, because numba compiles an assignment of one array to another for a second, with the texts of all its errors.
"""

from __future__ import annotations

import math

from hal.arrays import Array
from hal.jit import inlined

LEAST_PIVOT = 1e-13  # relative to the diagonal; below it a matrix counts as singular


@inlined
def factor(A: Array, D: Array, damping: float, floor: float, least: float, L: Array, n: int) -> bool:
    """Compute the lower factor `L` of A + damping diag(D) + floor I, all (n, n); `L` may be `A`.

    Returns False when a pivot is not above `least` times the entry of D, so that the matrix is not positive definite.
    """
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            if i == j:
                limit = least * D[i, i]
                s += damping * D[i, i] + floor
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > limit:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@inlined
def solve_lower(L: Array, b: Array, n: int) -> None:
    """Replace b by L^-1 b."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@inlined
def solve_upper(L: Array, b: Array, n: int) -> None:
    """Replace b by L^-T b."""
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= L[k, i] * b[k]
        b[i] = s / L[i, i]


@inlined
def solve_positive(A: Array, b: Array, n: int) -> bool:
    """Solve A x = b for n unknowns; overwrites `A` with its factor and `b` with x.

    Returns False when A is not positive definite.
    """
    if not factor(A, A, 0.0, 0.0, LEAST_PIVOT, A, n):
        return False
    solve_lower(A, b, n)
    solve_upper(A, b, n)
    return True


@inlined
def put1(into: Array, values: Array) -> None:
    """Copy a vector into another."""
    for i in range(values.shape[0]):
        into[i] = values[i]


@inlined
def put2(into: Array, values: Array) -> None:
    """Copy a matrix into another."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            into[i, j] = values[i, j]
