"""Depth and derivatives of one ray at a time, from which the loops over many rays must not differ."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, SPHERE, depth_on, normal_on


def depths_on(kind: int, th: Array, x: Array, y: Array, perspective: bool) -> Array:
    """Return `depth_on` of arrays x, y (N,)."""
    return np.array([depth_on(kind, th, *ray, perspective) for ray in zip(x, y, strict=True)])


def depth_and_jacobian(
    kind: int, th: Array, frame: Array, x: float, y: float, perspective: bool, J: Array,
) -> tuple[float, float]:  # fmt: skip
    """Return depth and cosine of incidence of a ray; fills `J` (9,) with the derivatives dz / d(tangent parameters).

    On the surface F = 0 the derivative is dz / dtheta = -(dF/dtheta) / (dF/dz). Depth is NaN where the ray misses.
    `frame` is that of `frame_of`.
    """
    z = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(z):
        return z, 0.0
    if perspective:
        px, py, dx, dy = x * z, y * z, x, y
    else:
        px, py, dx, dy = x, y, 0.0, 0.0
    nx, ny, nz = normal_on(kind, th, px, py, z)
    fz = nx * dx + ny * dy + nz
    cosine = abs(fz) / np.sqrt(dx * dx + dy * dy + 1.0)
    if abs(fz) < 1e-6:
        return np.nan, 0.0
    k = -1.0 / fz
    e1x, e1y, e1z, e2x, e2y, e2z = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    if kind == PLANE:
        J[0] = k * (px * e1x + py * e1y + z * e1z)
        J[1] = k * (px * e2x + py * e2y + z * e2z)
        J[2] = -k
        return z, cosine
    wx, wy, wz = px - th[0], py - th[1], z - th[2]
    if kind == SPHERE:
        J[0], J[1], J[2], J[3] = -k * nx, -k * ny, -k * nz, -k
    elif kind == CYLINDER:
        h = wx * th[3] + wy * th[4] + wz * th[5]
        n1, n2 = nx * e1x + ny * e1y + nz * e1z, nx * e2x + ny * e2y + nz * e2z
        J[0], J[1], J[2], J[3], J[4] = -k * n1, -k * n2, -k * h * n1, -k * h * n2, -k
    elif kind == CONE:
        h = wx * th[3] + wy * th[4] + wz * th[5]
        q1, q2 = wx * e1x + wy * e1y + wz * e1z, wx * e2x + wy * e2y + wz * e2z
        rho = np.sqrt(q1 * q1 + q2 * q2) + 1e-30
        ca, sa = np.cos(th[6]), np.sin(th[6])
        tilt = -(ca * h / rho + sa)
        J[0], J[1], J[2] = -k * nx, -k * ny, -k * nz
        J[3], J[4] = k * tilt * q1, k * tilt * q2
        J[5] = -k * (rho * sa + h * ca)
    else:
        s = 1.0 / th[3]
        wx, wy, wz = wx * s, wy * s, wz * s
        gx = 2.0 * th[4] * wx + th[7] * wy + th[8] * wz + th[10]
        gy = 2.0 * th[5] * wy + th[7] * wx + th[9] * wz + th[11]
        gz = 2.0 * th[6] * wz + th[8] * wx + th[9] * wy + th[12]
        slope = (gx * dx + gy * dy + gz) * s
        if abs(slope) < 1e-12:
            return np.nan, 0.0
        k = -1.0 / slope
        zz = wz * wz
        J[0], J[1] = k * (wx * wx - zz), k * (wy * wy - zz)
        J[2], J[3], J[4] = k * wx * wy, k * wx * wz, k * wy * wz
        J[5], J[6], J[7], J[8] = k * wx, k * wy, k * wz, k
    return z, cosine
