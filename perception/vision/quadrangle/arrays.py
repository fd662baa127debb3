"""Compiled array routines of the pose of four points: pixels to ideal coordinates, the object's plane, covariances."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.small_algebra import factor, solve_lower, solve_upper
from perception.vision.quadrangle.cost import LEAST_PIVOT
from perception.vision.quadrangle.three_point import cofactors, real_cubic_root


@compiled
def prepare(pixels: Array, covariance: Array, camera: Array, m: Array, A: Array) -> int:
    """Convert pixels (N, 2) with covariance (N, 2, 2) to ideal normalised coordinates m and their information A (N, 3).

    `camera` (9,): fx, fy, cx, cy, k1, k2, p1, p2, k3. The lens distortion is inverted by Newton's method, see
    `camera_model`.

    Returns: -1 if all is well; the index of a point that the lens model cannot have produced; or N + the index of a
    covariance that is not symmetric positive definite.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    bent = k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0
    count: int = pixels.shape[0]
    for i in range(count):
        xd, yd = (pixels[i, 0] - cx) / fx, (pixels[i, 1] - cy) / fy
        x, y = xd, yd
        jxx, jxy, jyy = 1.0, 0.0, 1.0
        if bent:
            error = np.inf
            for _ in range(20):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
                ex = xd - (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x))
                ey = yd - (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
                jxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                jyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                jxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                det = jxx * jyy - jxy * jxy
                if not det > 0.0:
                    return i
                error = abs(ex) + abs(ey)
                if error < 1e-14:
                    break
                x += (jyy * ex - jxy * ey) / det
                y += (jxx * ey - jxy * ex) / det
            if not error < 1e-9:
                return i
        m[i, 0], m[i, 1] = x, y
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        det = a * c - b * b
        if not (a > 0.0 and det > 0.0 and b == covariance[i, 1, 0]):
            return count + i
        # Information of the pixel, then by the chain rule that of the ideal coordinate: A = J^T S^-1 J.
        iu, iv, iw = c / det, -b / det, a / det
        g00, g01, g10, g11 = fx * jxx, fx * jxy, fy * jxy, fy * jyy
        A[i, 0] = g00 * g00 * iu + 2.0 * g00 * g10 * iv + g10 * g10 * iw
        A[i, 1] = g00 * g01 * iu + (g00 * g11 + g10 * g01) * iv + g10 * g11 * iw
        A[i, 2] = g01 * g01 * iu + 2.0 * g01 * g11 * iv + g11 * g11 * iw
    return -1


@inlined
def plane_of(X: Array) -> tuple[Array, float]:
    """Return the unit normal of the plane nearest to centred points X (N, 3), and their spread in this plane (m^2).

    The spread is that perpendicular to their main direction; it is zero for points on a line.
    """
    M = np.zeros((3, 3))
    for n in range(X.shape[0]):
        for i in range(3):
            for j in range(3):
                M[i, j] += X[n, i] * X[n, j]
    trace = M[0, 0] + M[1, 1] + M[2, 2]
    normal = np.zeros(3)
    if not trace > 0.0:
        return normal, 0.0
    for i in range(3):
        for j in range(3):
            M[i, j] /= trace
    C = cofactors(M)
    second = C[0, 0] + C[1, 1] + C[2, 2]
    det = M[0, 0] * C[0, 0] + M[0, 1] * C[0, 1] + M[0, 2] * C[0, 2]
    least = -real_cubic_root(1.0, second, det)  # the characteristic polynomial in -lambda
    for i in range(3):
        M[i, i] -= least
    C = cofactors(M)  # proportional to n n^T
    k = 0
    for i in range(1, 3):
        if C[i, i] > C[k, k]:
            k = i
    size = np.sqrt(C[0, k] ** 2 + C[1, k] ** 2 + C[2, k] ** 2)
    if size > 0.0:
        for i in range(3):
            normal[i] = C[i, k] / size
    return normal, second * trace


@compiled
def inverse6(N: Array, out: Array) -> bool:
    """Compute the inverse of a 6x6 matrix into `out`; returns False if the matrix is not positive definite."""
    x, L = np.empty(6), np.zeros((6, 6))
    if not factor(N, N, 0.0, 0.0, LEAST_PIVOT, L, 6):
        return False
    for k in range(6):
        for i in range(6):
            x[i] = 1.0 if i == k else 0.0
        solve_lower(L, x, 6)
        solve_upper(L, x, 6)
        for i in range(6):
            out[i, k] = x[i]
    for i in range(6):
        for j in range(i):
            out[i, j] = out[j, i] = 0.5 * (out[i, j] + out[j, i])
    return True


@inlined
def log_det6(C: Array) -> float:
    """Return the log determinant of a positive definite 6x6 matrix."""
    L = np.zeros((6, 6))
    factor(C, C, 0.0, 0.0, LEAST_PIVOT, L, 6)
    total = 0.0
    for i in range(6):
        total += 2.0 * np.log(L[i, i])
    return total


@inlined
def move_origin(C: Array, lever: Array) -> None:
    """Convert the covariance C of a pose to the origin at -lever (camera axes): d <- d + [lever]x r, in place."""
    for _ in range(2):  # J C, then (J (J C)^T)^T by the same loop on the transpose
        for k in range(6):
            r0, r1, r2 = C[3, k], C[4, k], C[5, k]
            C[0, k] += lever[1] * r2 - lever[2] * r1
            C[1, k] += lever[2] * r0 - lever[0] * r2
            C[2, k] += lever[0] * r1 - lever[1] * r0
        for i in range(6):
            for j in range(i):
                C[i, j], C[j, i] = C[j, i], C[i, j]
