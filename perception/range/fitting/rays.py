"""Vectorised intersection of many rays with one surface: depth, cosine of incidence and derivatives.

On the surface F = 0 the derivative is dz / dtheta = -(dF/dtheta) / (dF/dz); a test compares with plain functions of one
ray. Samples are processed in rows of one scratch array, and the loop bodies have no branch, so that the compiler
handles four or eight rays with one instruction: 6 ns per ray with its derivatives, against 80 ns for the reference.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import REORDERED, as_numpy_scalar, compiled
from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, SPHERE

CHUNK = 304  # largest number of samples of a fit; the rows of more would not fit the cache
ROWS = [row * CHUNK for row in range(18)]  # where each row of the scratch array begins
DEPTH, COSINE = ROWS[:2]
D0, D1, D2, D3, D4, D5, D6, D7, D8 = ROWS[2:11]  # derivatives of depth with respect to the tangent parameters
WEIGHT, RESIDUAL = ROWS[11:13]
X, Y, Z, SIGMA = ROWS[13:17]  # the samples
ERROR = ROWS[17]  # residuals before the robust weights; NaN where a ray misses
SCRATCH = len(ROWS) * CHUNK
# Which rows are valid: the samples; also row ERROR of the surface; all rows.
LOADED, ERRED, FILLED = (as_numpy_scalar(row) for row in range(3))


@compiled
def load_rows(samples: Array, work: Array) -> None:
    """Copy samples (4, N) of x, y, z and sigma, N <= CHUNK, into `work`.

    Compiled loops over several arrays test at run time whether these overlap in memory, and their rounding depends on
    the outcome. Loops within one array at fixed offsets need no such test, so equal input gives bit-identical results.
    """
    if samples.shape[1] > CHUNK:
        raise ValueError("more samples than fit the scratch array")
    for row in range(4):
        for i in range(samples.shape[1]):
            work[X + row * CHUNK + i] = samples[row, i]


@compiled
def fill_rows(kind: int, th: Array, frame: Array, n: int, perspective: bool, work: Array) -> None:
    """Write depth, cosine of incidence and derivatives of the `n` loaded samples into `work`.

    `work` (SCRATCH,) holds rows of CHUNK numbers; n <= CHUNK. Depth is NaN where a ray misses.
    """
    p = 1.0 if perspective else 0.0
    if kind == PLANE:
        _plane(th, frame, n, p, work)
    elif kind == SPHERE:
        _sphere(th, n, p, work)
    elif kind == CYLINDER:
        _cylinder(th, frame, n, p, work)
    elif kind == CONE:
        _cone(th, frame, n, p, work)
    else:
        _quadric(th, n, p, work)


@compiled(fastmath=REORDERED)
def _plane(th: Array, frame: Array, n: int, p: float, work: Array) -> None:
    """Fill the rows for a plane; `p`, here and below, is 1 for perspective rays and 0 for parallel ones."""
    nx, ny, nz, d = th[0], th[1], th[2], th[3]
    e0, e1, e2, f0, f1, f2 = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    for i in range(n):
        xi, yi = work[X + i], work[Y + i]
        dx, dy = p * xi, p * yi
        ox, oy = xi - dx, yi - dy
        facing = nx * dx + ny * dy + nz
        k = -1.0 / facing
        z = (nx * ox + ny * oy - d) * k if abs(facing) > 1e-6 else np.nan
        px, py = ox + z * dx, oy + z * dy
        work[DEPTH + i] = z
        work[COSINE + i] = abs(facing) / np.sqrt(dx * dx + dy * dy + 1.0)
        work[D0 + i] = k * (px * e0 + py * e1 + z * e2)
        work[D1 + i] = k * (px * f0 + py * f1 + z * f2)
        work[D2 + i] = -k


@compiled(fastmath=REORDERED)
def _sphere(th: Array, n: int, p: float, work: Array) -> None:
    """Fill the rows for a sphere."""
    cx, cy, cz, r = th[0], th[1], th[2], th[3]
    side = 1.0 if th[4] > 0 else -1.0
    inverse_r = 1.0 / r
    for i in range(n):
        xi, yi = work[X + i], work[Y + i]
        dx, dy = p * xi, p * yi
        wx, wy = xi - dx - cx, yi - dy - cy
        a = dx * dx + dy * dy + 1.0
        b = dx * wx + dy * wy - cz
        c = wx * wx + wy * wy + cz * cz - r * r
        z = (-b - side * np.sqrt(b * b - a * c)) / a
        nx, ny, nz = (wx + z * dx) * inverse_r, (wy + z * dy) * inverse_r, (z - cz) * inverse_r
        facing = nx * dx + ny * dy + nz
        k = 1.0 / facing
        work[DEPTH + i] = z if abs(facing) > 1e-6 else np.nan
        work[COSINE + i] = abs(facing) / np.sqrt(a)
        work[D0 + i] = k * nx
        work[D1 + i] = k * ny
        work[D2 + i] = k * nz
        work[D3 + i] = k


@compiled(fastmath=REORDERED)
def _cylinder(th: Array, frame: Array, n: int, p: float, work: Array) -> None:
    """Fill the rows for a cylinder."""
    cx, cy, cz, ax, ay, az, r = th[0], th[1], th[2], th[3], th[4], th[5], th[6]
    e0, e1, e2, f0, f1, f2 = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    side = 1.0 if th[7] > 0 else -1.0
    inverse_r = 1.0 / r
    for i in range(n):
        xi, yi = work[X + i], work[Y + i]
        dx, dy = p * xi, p * yi
        wx, wy = xi - dx - cx, yi - dy - cy
        da = dx * ax + dy * ay + az
        wa = wx * ax + wy * ay - cz * az
        d2 = dx * dx + dy * dy + 1.0
        a = d2 - da * da
        b = dx * wx + dy * wy - cz - da * wa
        c = wx * wx + wy * wy + cz * cz - wa * wa - r * r
        z = (-b - side * np.sqrt(b * b - a * c)) / a
        h = wa + z * da
        # The normal needs no square root, because the distance of a surface point from the axis is the radius.
        nx = (wx + z * dx - h * ax) * inverse_r
        ny = (wy + z * dy - h * ay) * inverse_r
        nz = (z - cz - h * az) * inverse_r
        facing = nx * dx + ny * dy + nz
        k = 1.0 / facing
        n1, n2 = k * (nx * e0 + ny * e1 + nz * e2), k * (nx * f0 + ny * f1 + nz * f2)
        work[DEPTH + i] = z if abs(facing) > 1e-6 else np.nan
        work[COSINE + i] = abs(facing) / np.sqrt(d2)
        work[D0 + i] = n1
        work[D1 + i] = n2
        work[D2 + i] = h * n1
        work[D3 + i] = h * n2
        work[D4 + i] = k


@compiled(fastmath=REORDERED)
def _cone(th: Array, frame: Array, n: int, p: float, work: Array) -> None:
    """Fill the rows for a cone; intersections with the other half of the double cone are discarded."""
    cx, cy, cz, ax, ay, az = th[0], th[1], th[2], th[3], th[4], th[5]
    e0, e1, e2, f0, f1, f2 = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    outside = th[7] > 0
    ca, sa = np.cos(th[6]), np.sin(th[6])
    square = ca * ca
    for i in range(n):
        xi, yi = work[X + i], work[Y + i]
        dx, dy = p * xi, p * yi
        wx, wy = xi - dx - cx, yi - dy - cy
        da = dx * ax + dy * ay + az
        wa = wx * ax + wy * ay - cz * az
        d2 = dx * dx + dy * dy + 1.0
        a = square * d2 - da * da
        b = square * (dx * wx + dy * wy - cz) - da * wa
        c = square * (wx * wx + wy * wy + cz * cz) - wa * wa
        root = np.sqrt(b * b - a * c)
        one, two = (-b - root) / a, (-b + root) / a
        near, far = min(one, two), max(one, two)
        near = near if wa + near * da > 0.0 else np.nan  # NaN on the other half of the double cone
        far = far if wa + far * da > 0.0 else np.nan
        wanted, other = (near, far) if outside else (far, near)
        z = other if np.isnan(wanted) else wanted
        h = wa + z * da
        qx, qy, qz = wx + z * dx, wy + z * dy, z - cz
        gx, gy, gz = qx - h * ax, qy - h * ay, qz - h * az
        rho = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30
        scale = ca / rho
        nx, ny, nz = scale * gx - sa * ax, scale * gy - sa * ay, scale * gz - sa * az
        facing = nx * dx + ny * dy + nz
        k = -1.0 / facing
        tilt = -k * (scale * h + sa)
        work[DEPTH + i] = z if abs(facing) > 1e-6 and abs(a) > 1e-15 else np.nan
        work[COSINE + i] = abs(facing) / np.sqrt(d2)
        work[D0 + i] = -k * nx
        work[D1 + i] = -k * ny
        work[D2 + i] = -k * nz
        work[D3 + i] = tilt * (qx * e0 + qy * e1 + qz * e2)
        work[D4 + i] = tilt * (qx * f0 + qy * f1 + qz * f2)
        work[D5 + i] = -k * (rho * sa + h * ca)


@compiled(fastmath=REORDERED)
def _quadric(th: Array, n: int, p: float, work: Array) -> None:
    """Fill the rows for a quadric."""
    s = 1.0 / th[3]
    cx, cy, cz = th[0] * s, th[1] * s, th[2] * s
    qxx, qyy, qzz, qxy, qxz, qyz, qx, qy, qz, q0 = (
        th[4], th[5], th[6], th[7], th[8], th[9], th[10], th[11], th[12], th[13],
    )  # fmt: skip
    for i in range(n):
        xi, yi = work[X + i], work[Y + i]
        dx, dy, dz = p * xi * s, p * yi * s, s
        wx, wy, wz = xi * s - dx - cx, yi * s - dy - cy, -cz
        # Along the ray the quadric is a z^2 + 2 b z + c; u is the gradient of its quadratic part at the ray direction.
        ux, uy, uz = 2.0 * qxx * dx + qxy * dy + qxz * dz, 2.0 * qyy * dy + qxy * dx + qyz * dz, 0.0
        uz = 2.0 * qzz * dz + qxz * dx + qyz * dy
        a = 0.5 * (ux * dx + uy * dy + uz * dz)
        b = 0.5 * (ux * wx + uy * wy + uz * wz + qx * dx + qy * dy + qz * dz)
        c = (
            wx * (qxx * wx + qxy * wy + qxz * wz + qx)
            + wy * (qyy * wy + qyz * wz + qy)
            + wz * (qzz * wz + qz)
            + q0
        )  # fmt: skip
        root = np.sqrt(b * b - a * c)
        root = -root if a < 0.0 else root
        z = (-b - root) / a if abs(a) > 1e-14 * (abs(b) + 1e-30) else -0.5 * c / b + 0.0 * root
        wx, wy, wz = wx + z * dx, wy + z * dy, wz + z * dz
        gx = 2.0 * qxx * wx + qxy * wy + qxz * wz + qx
        gy = 2.0 * qyy * wy + qxy * wx + qyz * wz + qy
        gz = 2.0 * qzz * wz + qxz * wx + qyz * wy + qz
        slope = gx * dx + gy * dy + gz * dz
        d2 = dx * dx + dy * dy + dz * dz
        cosine = abs(slope) / np.sqrt(d2 * (gx * gx + gy * gy + gz * gz) + 1e-300)
        k = -1.0 / slope
        zz = wz * wz
        work[DEPTH + i] = z if cosine * np.sqrt(d2) > 1e-6 * s and abs(slope) > 1e-12 else np.nan
        work[COSINE + i] = cosine
        work[D0 + i] = k * (wx * wx - zz)
        work[D1 + i] = k * (wy * wy - zz)
        work[D2 + i] = k * wx * wy
        work[D3 + i] = k * wx * wz
        work[D4 + i] = k * wy * wz
        work[D5 + i] = k * wx
        work[D6 + i] = k * wy
        work[D7 + i] = k * wz
        work[D8 + i] = k
