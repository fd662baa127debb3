"""Arithmetic of three-vectors and 3x3 matrices for the compiled loops of the pose of four points.

Array expressions, `np.cross` and `@` would be easier to read, but each use takes up to a second to compile.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import inlined


@inlined
def product3(A: Array, B: Array) -> Array:
    """Return A @ B, both 3x3."""
    C = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return C


@inlined
def times3(M: Array, v: Array) -> Array:
    """Return M @ v for a 3x3 matrix and a vector (3,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = M[i, 0] * v[0] + M[i, 1] * v[1] + M[i, 2] * v[2]
    return x


@inlined
def back3(M: Array, v: Array, factor: float) -> Array:
    """Return factor * M^T @ v for a 3x3 matrix and a vector (3,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = factor * (M[0, i] * v[0] + M[1, i] * v[1] + M[2, i] * v[2])
    return x


@inlined
def dot3(a: Array, b: Array) -> float:
    """Return a . b of two vectors (3,)."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@inlined
def cross3(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,)."""
    x = np.empty(3)
    x[0] = a[1] * b[2] - a[2] * b[1]
    x[1] = a[2] * b[0] - a[0] * b[2]
    x[2] = a[0] * b[1] - a[1] * b[0]
    return x


@inlined
def mix3(p: float, a: Array, q: float, b: Array) -> Array:
    """Return p a + q b for numbers p, q and vectors a, b (3,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = p * a[i] + q * b[i]
    return x


@inlined
def unit3(a: Array) -> Array:
    """Return a / |a| of a vector (3,)."""
    norm = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    x = np.empty(3)
    for i in range(3):
        x[i] = a[i] / norm
    return x
