"""Three-vectors as tuples and small dense algebra for the compiled loops, without allocation or library calls.

Tuples of three floats stay in registers, and a call to LAPACK for a 6x6 system takes longer than its solution.
Symmetric 3x3 matrices are (xx, xy, xz, yy, yz, zz).
"""

from __future__ import annotations

import math

from hal.arrays import Array
from hal.jit import inlined
from hal.small_algebra import factor

Vec = tuple[float, float, float]
Sym = tuple[float, float, float, float, float, float]


@inlined
def vec(a: Array, i: int) -> Vec:
    """Return row i of an (N, 3) array."""
    return (a[i, 0], a[i, 1], a[i, 2])


@inlined
def sym(a: Array, i: int) -> Sym:
    """Return row i of an (N, 6) array of symmetric matrices."""
    return (a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5])


@inlined
def dot(a: Vec, b: Vec) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a: Vec, b: Vec) -> Vec:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def blend(s: float, a: Vec, t: float, b: Vec) -> Vec:
    """Return s a + t b."""
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2])


@inlined
def normalised(a: Vec) -> Vec:
    """Return a / |a|, or the z axis when a vanishes."""
    n = math.sqrt(dot(a, a))
    if n < 1e-300:
        return (0.0, 0.0, 1.0)
    return (a[0] / n, a[1] / n, a[2] / n)


@inlined
def across(a: Vec) -> Vec:
    """Return a unit vector perpendicular to the unit vector a."""
    if abs(a[0]) < 0.6:
        return normalised((0.0, -a[2], a[1]))
    return normalised((a[2], 0.0, -a[0]))


@inlined
def times(S: Sym, a: Vec) -> Vec:
    """Return S a."""
    return (
        S[0] * a[0] + S[1] * a[1] + S[2] * a[2],
        S[1] * a[0] + S[3] * a[1] + S[4] * a[2],
        S[2] * a[0] + S[4] * a[1] + S[5] * a[2],
    )


@inlined
def form(a: Vec, S: Sym, b: Vec) -> float:
    """Return a . S b."""
    return dot(a, times(S, b))


@inlined
def turned(R: Array, a: Vec) -> Vec:
    """Return R a."""
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@inlined
def cholesky(S: Array, n: int) -> bool:
    """Compute the lower factor of the leading n x n block in place; returns False when it is not positive definite."""
    return factor(S, S, 0.0, 0.0, 0.0, S, n)


@inlined
def move(R: Array, t: Array, delta: Array) -> None:
    """Move a pose in place: t <- t + d, R <- Exp(r) R for delta = (d, r), (6,)."""
    t[0] += delta[0]
    t[1] += delta[1]
    t[2] += delta[2]
    x, y, z = delta[3], delta[4], delta[5]
    a2 = x * x + y * y + z * z
    a = math.sqrt(a2)
    if a < 1e-6:
        s, c = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        s, c = math.sin(a) / a, (1.0 - math.cos(a)) / a2
    for j in range(3):
        v = (R[0, j], R[1, j], R[2, j])
        w = cross((x, y, z), v)
        ww = cross((x, y, z), w)
        R[0, j] = v[0] + s * w[0] + c * ww[0]
        R[1, j] = v[1] + s * w[1] + c * ww[1]
        R[2, j] = v[2] + s * w[2] + c * ww[2]


@inlined
def rotation_vector(R: Array, Q: Array) -> Vec:
    """Return log(R Q^T), the rotation vector that takes Q to R, in base axes."""
    x = y = z = 0.0
    trace = 0.0
    for k in range(3):
        x += R[2, k] * Q[1, k] - R[1, k] * Q[2, k]
        y += R[0, k] * Q[2, k] - R[2, k] * Q[0, k]
        z += R[1, k] * Q[0, k] - R[0, k] * Q[1, k]
        trace += R[0, k] * Q[0, k] + R[1, k] * Q[1, k] + R[2, k] * Q[2, k]
    s, c = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (trace - 1.0)
    a = math.atan2(s, c)
    k2 = 0.5 * a / s if s > 1e-9 else (0.5 if c > 0.0 else 0.5 * math.pi / 1e-9)
    return (k2 * x, k2 * y, k2 * z)
