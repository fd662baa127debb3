"""Initial parameters of fits, by algebraic fits to points and normals, with the small linear algebra that they need.

`P` (N, 3) are points and `N` (N, 3) their unit normals towards the sensor.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled
from hal.small_algebra import solve_positive
from perception.range.fitting.surfaces import SIZE, tangent_frame

MOST_SWEEPS = 12  # of Jacobi rotations; a 3x3 matrix converges in four or five


@compiled
def principal_axes(S: Array) -> tuple[Array, Array]:
    """Return eigenvalues (3,), smallest first, and eigenvectors (3, 3), in columns, of a symmetric matrix.

    Uses cyclic Jacobi rotations (Golub and Van Loan, 8.5), ten times as fast as a LAPACK call at this size.
    """
    A, V, values = S.copy(), np.eye(3), np.empty(3)
    size = abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])
    for _ in range(MOST_SWEEPS):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off <= 1e-16 * size:
            break
        for i in range(2):
            for j in range(i + 1, 3):
                if A[i, j] == 0.0:
                    continue
                theta = (A[j, j] - A[i, i]) / (2.0 * A[i, j])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                t = t if theta >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    A[k, i], A[k, j] = c * A[k, i] - s * A[k, j], s * A[k, i] + c * A[k, j]
                for k in range(3):
                    A[i, k], A[j, k] = c * A[i, k] - s * A[j, k], s * A[i, k] + c * A[j, k]
                for k in range(3):
                    V[k, i], V[k, j] = c * V[k, i] - s * V[k, j], s * V[k, i] + c * V[k, j]
    for k in range(3):
        values[k] = A[k, k]
    for j in (1, 2, 1):  # bubble sort: swap neighbours that are in the wrong order
        if values[j] < values[j - 1]:
            values[j - 1], values[j] = values[j], values[j - 1]
            for k in range(3):
                V[k, j - 1], V[k, j] = V[k, j], V[k, j - 1]
    return values, V


@compiled
def centroid(P: Array) -> Array:
    """Return the mean (3,) of points (N, 3)."""
    return np.array([np.mean(P[:, 0]), np.mean(P[:, 1]), np.mean(P[:, 2])])


@compiled
def scatter(P: Array, c: Array) -> Array:
    """Return the scatter matrix (3, 3) of points (N, 3) about c: the sum of (P_i - c)(P_i - c)'."""
    off = P - c
    return off.T @ off


@compiled
def start_plane(P: Array) -> Array:
    """Fit a plane to points (N, 3): its normal is the principal axis of least scatter."""
    th = np.zeros(SIZE)
    c = centroid(P)
    _, V = principal_axes(scatter(P, c))
    side = -1.0 if V[2, 0] > 0 else 1.0  # towards the sensor, except for planes nearly parallel to the rays
    for a in range(3):
        th[a] = side * V[a, 0]
        th[3] += th[a] * c[a]
    return th


@compiled
def _least_squares(rows: Array, values: Array) -> tuple[Array, bool]:
    """Solve rows (N, m) x = values (N,) by normal equations; returns x and whether there is a solution."""
    A, b = rows.T @ rows, rows.T @ values
    for j in range(b.shape[0]):
        A[j, j] = A[j, j] * (1.0 + 1e-9) + 1e-18
    return b, solve_positive(A, b, b.shape[0])


@compiled
def _side(P: Array, N: Array, th: Array, axis: Array) -> float:
    """Return +1 if the normals point away from the centre or axis of `th`, and -1 if they point towards it."""
    outward = 0.0
    for i in range(P.shape[0]):
        x, y, z = P[i, 0] - th[0], P[i, 1] - th[1], P[i, 2] - th[2]
        h = x * axis[0] + y * axis[1] + z * axis[2]
        outward += N[i, 0] * (x - h * axis[0]) + N[i, 1] * (y - h * axis[1]) + N[i, 2] * (z - h * axis[2])
    return 1.0 if outward >= 0 else -1.0


@compiled
def start_sphere(P: Array, N: Array) -> tuple[Array, bool]:
    """Fit a sphere algebraically, |X|^2 = 2 c . X + k about the centroid; the normals determine the side.

    Returns the parameters, and whether there is a solution.
    """
    th = np.zeros(SIZE)
    c = centroid(P)
    n = P.shape[0]
    rows, values = np.ones((n, 4)), np.zeros(n)
    for i in range(n):
        for a in range(3):
            d = P[i, a] - c[a]
            rows[i, a] = 2.0 * d
            values[i] += d * d
    b, ok = _least_squares(rows, values)
    if not ok:
        return th, False
    square = b[3]
    for a in range(3):
        th[a] = c[a] + b[a]
        square += b[a] * b[a]
    th[3] = np.sqrt(max(square, 1e-12))
    th[4] = _side(P, N, th, np.zeros(3))
    return th, True


@compiled
def normal_axis(N: Array, centred: bool) -> Array:
    """Return the direction of least scatter of the normals: the axis of a cylinder, or (`centred`) of a cone.

    Normals of a cylinder are perpendicular to its axis; those of a cone have a constant component along it.
    """
    _, V = principal_axes(scatter(N, centroid(N) if centred else np.zeros(3)))
    return V[:, 0].copy()


@compiled
def start_cylinder(P: Array, N: Array, axis: Array) -> tuple[Array, bool]:
    """Fit a cylinder with a known axis direction: an algebraic circle through the points projected along `axis`.

    Returns the parameters, and whether there is a solution.
    """
    th = np.zeros(SIZE)
    e = tangent_frame(axis[0], axis[1], axis[2])
    c = centroid(P)
    n = P.shape[0]
    rows, values = np.ones((n, 3)), np.zeros(n)
    for i in range(n):
        x, y, z = P[i, 0] - c[0], P[i, 1] - c[1], P[i, 2] - c[2]
        p, q = x * e[0] + y * e[1] + z * e[2], x * e[3] + y * e[4] + z * e[5]
        rows[i, 0], rows[i, 1] = 2.0 * p, 2.0 * q
        values[i] = p * p + q * q
    b, ok = _least_squares(rows, values)
    if not ok:
        return th, False
    for a in range(3):
        th[a] = c[a] + b[0] * e[a] + b[1] * e[3 + a]
        th[3 + a] = axis[a]
    th[6] = np.sqrt(max(b[2] + b[0] * b[0] + b[1] * b[1], 1e-12))
    th[7] = _side(P, N, th, axis)
    return th, True


@compiled
def start_cone(P: Array, N: Array, axis: Array) -> tuple[Array, bool]:
    """Fit a cone algebraically: the apex from n . X = n . apex, the angle from n . axis = -sin(angle).

    Returns the parameters, and whether there is a solution.
    """
    th = np.zeros(SIZE)
    c = centroid(P)
    n = P.shape[0]
    values = np.zeros(n)
    along = 0.0
    for i in range(n):
        for a in range(3):
            values[i] += N[i, a] * (P[i, a] - c[a])
            along += N[i, a] * axis[a] / n
    b, ok = _least_squares(N, values)
    if not ok:
        return th, False
    inward = 1.0 if b[0] * axis[0] + b[1] * axis[1] + b[2] * axis[2] < 0 else -1.0
    for a in range(3):
        th[a] = c[a] + b[a]
        th[3 + a] = inward * axis[a]
    th[6] = min(max(np.arcsin(min(abs(along), 0.999)), 0.02), 1.5)
    th[7] = _side(P, N, th, th[3:6])
    return th, True


@compiled
def quadric_of_sphere(th: Array) -> Array:
    """Return a sphere as a quadric about its centre: the initial parameters of an ellipsoid fit."""
    out = np.zeros(SIZE)
    out[:3] = th[:3]
    out[3] = max(th[3], 1e-6)
    out[4], out[5], out[6], out[13] = 1.0, 1.0, 1.0, -1.0
    return out


@compiled
def ellipsoid(th: Array) -> tuple[Array, Array, Array]:
    """Return centre (3,), radii (3,), longest first, and axes (3, 3), in columns, of a quadric.

    With X = centre + s Y and Y' A Y + 2 b' Y + c = 0: Y0 = -A^-1 b, radii_i = s sqrt((b' A^-1 b - c) / lambda_i), which
    is 0 where the quadric is no ellipsoid in that direction.
    """
    A = np.array(
        [[th[4], 0.5 * th[7], 0.5 * th[8]], [0.5 * th[7], th[5], 0.5 * th[9]], [0.5 * th[8], 0.5 * th[9], th[6]]]
    )
    values, vectors = principal_axes(A)
    centre, radii, level = th[:3].copy(), np.empty(3), -th[13]
    for k in range(3):
        t = 0.5 * (vectors[0, k] * th[10] + vectors[1, k] * th[11] + vectors[2, k] * th[12])
        level += t * t / values[k]
        for a in range(3):
            centre[a] -= th[3] * vectors[a, k] * t / values[k]
    for k in range(3):
        radii[k] = th[3] * np.sqrt(max(level / values[k], 0.0))
    return centre, radii, vectors


@compiled
def is_ellipsoid(th: Array) -> bool:
    """Return whether the quadric is a real ellipsoid whose longest radius is less than 8 times the shortest."""
    _, radii, _ = ellipsoid(th)
    return bool(0.0 < radii[0] < 8.0 * radii[2])
