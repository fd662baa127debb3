"""Fits general quadrics: by parallel Givens QR, which is stable, or by additive moments, which are faster.

A quadric is q . m(X) = 0 with m = (x^2, y^2, z^2, xy, xz, yz, x, y, z, 1), |q| = 1. Points are first centred and
scaled, because the design matrix of a region half a metre away has a condition number of 1e6, but below 10 when
centred.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.errors import NotObservable
from hal.jit import compiled
from perception.range import SurfaceType

TERMS = 10
FLAT_RATIO = 1e-6  # residual ratio below which a second quadric fits as well: the points do not determine one
ZERO_RATIO = 0.02  # eigenvalues below this fraction of the largest one count as zero in the classification
EQUAL_RATIO = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Quadric:
    """Quadric: unit-length `coefficients` (10,) for (X - centre_m) / scale_m; `rms` is the algebraic residual."""

    coefficients: Array
    centre_m: Array
    scale_m: float
    rms: float

    def value(self, points_m: Array) -> Array:
        """Return q . m(X) for points (N, 3)."""
        return np.asarray(monomials((points_m - self.centre_m) / self.scale_m) @ self.coefficients)

    def matrix(self) -> tuple[Array, Array, float]:
        """Return A (3, 3), b (3,), c of Y' A Y + 2 b' Y + c = 0 in centred and scaled coordinates."""
        q = self.coefficients
        A = np.array([[q[0], q[3] / 2, q[4] / 2], [q[3] / 2, q[1], q[5] / 2], [q[4] / 2, q[5] / 2, q[2]]])
        return A, q[6:9] / 2, float(q[9])


def monomials(points: Array) -> Array:
    """Return the (N, 10) design matrix of points (N, 3)."""
    x, y, z = points.T
    return np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones_like(x)], axis=1)


def fit_qr(points_m: Array, *, leaves: int = 1, pool: ThreadPoolExecutor | None = None) -> Quadric:
    """Fit a quadric by a tree of Givens QR factorisations over `leaves` parts of the points (N, 3).

    Each leaf reduces its rows to a 10x10 triangle; triangles are merged in pairs in log2(leaves) rounds, as in the
    paper's parallel Givens algorithm on a hypercube. The quadric is the last right singular vector of the final
    triangle.

    Raises:
        NotObservable: fewer than 9 points, or more than one quadric fits them.
    """
    centre, scale = _normalisation(points_m)
    rows = monomials((points_m - centre) / scale)
    parts = np.array_split(rows, max(1, min(leaves, len(rows) // TERMS or 1)))
    triangles = list(pool.map(_triangle, parts)) if pool else [_triangle(part) for part in parts]
    while len(triangles) > 1:
        pairs = [np.vstack(triangles[k : k + 2]) for k in range(0, len(triangles), 2)]
        triangles = [_triangle(p) for p in pairs]
    _, s, vt = np.linalg.svd(triangles[0])
    return _named(s, vt[-1], centre, scale, len(points_m))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Sum of m m' over points for a fixed centre and scale; moments can be added, so regions are merged in O(1)."""

    total: Array
    centre_m: Array
    scale_m: float
    count: int

    def __add__(self, other: Moments) -> Moments:
        if not (np.array_equal(self.centre_m, other.centre_m) and self.scale_m == other.scale_m):
            raise ValueError("moments about different centres do not add")
        return Moments(
            total=self.total + other.total,
            centre_m=self.centre_m,
            scale_m=self.scale_m,
            count=self.count + other.count,
        )

    def fit(self) -> Quadric:
        """Return the quadric of these points, accurate to about 4e-8 rad if centred and scaled; raises as `fit_qr`."""
        values, vectors = np.linalg.eigh(self.total)
        return _named(np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, 0], self.centre_m, self.scale_m, self.count)


def moments(points_m: Array, *, centre_m: Array, scale_m: float) -> Moments:
    """Return the moments of points (N, 3) for a given centre and scale."""
    m = monomials((points_m - centre_m) / scale_m)
    return Moments(total=m.T @ m, centre_m=centre_m, scale_m=scale_m, count=len(points_m))


def classify(quadric: Quadric) -> SurfaceType | None:
    """Return the type of a quadric from its eigenvalues; None for hyperboloids, paraboloids and the empty set."""
    A, b, c = quadric.matrix()
    values, vectors = np.linalg.eigh(A)
    size = np.abs(values).max()
    if size < ZERO_RATIO * max(float(np.abs(b).max()), 1e-12):
        return SurfaceType.PLANE
    zero = np.abs(values) < ZERO_RATIO * size
    t = vectors.T @ b
    if zero.sum() == 1 and np.abs(t[zero]).max() < ZERO_RATIO * size:
        pair = values[~zero]
        return SurfaceType.CYLINDER if pair[0] * pair[1] > 0 else None
    if zero.sum() == 2 and np.abs(t[zero]).max() < ZERO_RATIO * size:
        return SurfaceType.PLANE  # two parallel planes, or one counted twice
    if zero.any():
        return None
    level = float(np.sum(t**2 / values)) - c
    signs = np.sign(values)
    if np.all(signs == signs[0]):
        if level * signs[0] <= 0:
            return None
        return SurfaceType.SPHERE if np.ptp(values) < EQUAL_RATIO * size else SurfaceType.ELLIPSOID
    # The apex of a cone lies on it, with a tolerance that grows with the distance from the apex to the data.
    apex = t / values
    return SurfaceType.CONE if abs(level) < EQUAL_RATIO * size * max(float(apex @ apex), 1.0) else None


def _normalisation(points_m: Array) -> tuple[Array, float]:
    if len(points_m) < TERMS - 1:
        raise NotObservable(f"{len(points_m)} points do not determine a quadric", hint="give at least 9 points")
    centre = points_m.mean(axis=0)
    return centre, float(max(np.sqrt(np.mean((points_m - centre) ** 2)), 1e-12))


def _named(s: Array, q: Array, centre: Array, scale: float, count: int) -> Quadric:
    if s[-2] <= FLAT_RATIO * s[0]:
        raise NotObservable(
            "more than one quadric fits these points", hint="they lie on a plane or a line: fit that instead"
        )
    return Quadric(coefficients=q, centre_m=centre, scale_m=scale, rms=float(s[-1] / np.sqrt(count)))


@compiled
def _triangle(rows: Array) -> Array:
    """Return the (10, 10) upper triangle R of rows (N, 10) by Givens rotations, one row at a time."""
    n = rows.shape[1]
    R = np.zeros((n, n))
    row = np.empty(n)
    for i in range(rows.shape[0]):
        for j in range(n):
            row[j] = rows[i, j]
        for j in range(n):
            if row[j] == 0.0:
                continue
            h = np.hypot(R[j, j], row[j])
            c, s = R[j, j] / h, row[j] / h
            for k in range(j, n):
                a, b = R[j, k], row[k]
                R[j, k] = c * a + s * b
                row[k] = c * b - s * a
    return R
