# mypy: disallow-untyped-defs=False
"""The compiler settings of the four-light pose, and the small vector arithmetic that its loops share.

Array expressions, `np.cross` and `@` would read better, but each costs up to a second of compile time where it stands.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile to machine code, cached beside the source; division by zero gives inf as in numpy."""
    return cast("Callable[..., Any]", numba.njit(cache=True, error_model="numpy")(function))


@jit
def product3(A, B):
    """A @ B, 3x3."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@jit
def times3(M, v):
    """M @ v, 3x3 and (3,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = M[i, 0] * v[0] + M[i, 1] * v[1] + M[i, 2] * v[2]
    return x


@jit
def back3(M, v, factor):
    """factor * M^T @ v, 3x3 and (3,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = factor * (M[0, i] * v[0] + M[1, i] * v[1] + M[2, i] * v[2])
    return x


@jit
def dot3(a, b):
    """a . b, (3,) each."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def cross3(a, b):
    """a x b, (3,) each."""
    x = np.empty(3)
    x[0] = a[1] * b[2] - a[2] * b[1]
    x[1] = a[2] * b[0] - a[0] * b[2]
    x[2] = a[0] * b[1] - a[1] * b[0]
    return x


@jit
def mix3(p, a, q, b):
    """p a + q b for numbers p, q and (3,) a, b."""
    x = np.empty(3)
    for i in range(3):
        x[i] = p * a[i] + q * b[i]
    return x


@jit
def unit3(a):
    """a / |a|, (3,)."""
    norm = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    x = np.empty(3)
    for i in range(3):
        x[i] = a[i] / norm
    return x


@jit
def put1(into, values):
    """Copy a vector."""
    for i in range(values.shape[0]):
        into[i] = values[i]


@jit
def put2(into, values):
    """Copy a matrix."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            into[i, j] = values[i, j]
