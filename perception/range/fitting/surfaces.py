"""Intersection of rays with primitives: depth and its derivatives (compiled).

A surface is a kind and a parameter vector of 16 numbers:

    PLANE      n (3), d                          n . X = d
    SPHERE     c (3), r, side                    |X - c| = r
    CYLINDER   c (3), axis (3), r, side          distance from the axis = r
    CONE       apex (3), axis (3), angle, side   angle between X - apex and the axis (into the cone) = angle
    QUADRIC    centre (3), scale, then 10 coefficients over (xx, yy, zz, xy, xz, yz, x, y, z, 1) of (X - centre) / scale

`side` is +1 for a surface seen from outside (the nearer root along the ray) and -1 from inside. A ray is given by its
coordinates x, y on the plane z = 1 (`perspective`) or in metres (parallel rays).

Fits change the tangent parameters of a surface: shifts, tilts of its unit vector towards the two vectors of
`tangent_frame`, and its sizes. `FREEDOM` is their number; `step_into` defines their order.
"""

# ruff: noqa: PLR0912, PLR1714, SIM109 - compiled loops take plain arrays, and long
# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import as_numpy_scalar, compiled

PLANE, SPHERE, CYLINDER, CONE, QUADRIC = (as_numpy_scalar(kind) for kind in range(5))
SIZE = 16
FREEDOM = np.array([3, 4, 5, 6, 9])  # number of tangent parameters of each kind
GRAZING_COSINE = 0.3  # below it pixels lose weight, because a depth residual there says little about the surface


@compiled
def tangent_frame(ax: float, ay: float, az: float) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors that complete the unit vector (ax, ay, az) to a right-handed frame."""
    if abs(ax) < 0.8:
        ux, uy, uz = 0.0, az, -ay
    else:
        ux, uy, uz = -az, 0.0, ax
    n = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / n, uy / n, uz / n
    return ux, uy, uz, ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux


@compiled
def _roots(a: float, b: float, c: float, side: float) -> float:
    """Return the nearer (side +1) or farther (side -1) root of a z^2 + 2 b z + c; NaN without a real root."""
    disc = b * b - a * c
    if disc < 0.0:
        return np.nan
    root = np.sqrt(disc)
    if abs(a) < 1e-14 * (abs(b) + 1e-30):
        return -0.5 * c / b
    if a < 0.0:
        root = -root
    return float((-b - root) / a if side > 0 else (-b + root) / a)


@compiled
def depth_on(kind: int, th: Array, x: float, y: float, perspective: bool) -> float:
    """Return the depth z at which the ray (x, y) meets the surface; NaN if it does not."""
    if perspective:
        ox, oy, dx, dy = 0.0, 0.0, x, y
    else:
        ox, oy, dx, dy = x, y, 0.0, 0.0
    if kind == PLANE:
        facing = th[0] * dx + th[1] * dy + th[2]
        if abs(facing) < 1e-9:
            return np.nan
        return float((th[3] - th[0] * ox - th[1] * oy) / facing)
    wx, wy, wz = ox - th[0], oy - th[1], -th[2]
    if kind == QUADRIC:
        return _depth_on_quadric(th, wx, wy, wz, dx, dy)
    dd, dw, ww = dx * dx + dy * dy + 1.0, dx * wx + dy * wy + wz, wx * wx + wy * wy + wz * wz
    if kind == SPHERE:
        return _roots(dd, dw, ww - th[3] * th[3], th[4])
    da = dx * th[3] + dy * th[4] + th[5]
    wa = wx * th[3] + wy * th[4] + wz * th[5]
    if kind == CYLINDER:
        return _roots(dd - da * da, dw - da * wa, ww - wa * wa - th[6] * th[6], th[7])
    k = np.cos(th[6]) ** 2
    return _root_on_cone(k * dd - da * da, k * dw - da * wa, k * ww - wa * wa, wa, da, th[7])


@compiled
def _root_on_cone(a: float, b: float, c: float, wa: float, da: float, side: float) -> float:
    """Return the root of a z^2 + 2 b z + c that lies on the cone itself, where wa + z da > 0; NaN if none does."""
    disc = b * b - a * c
    if disc < 0.0 or abs(a) < 1e-15:
        return np.nan
    root = np.sqrt(disc)
    near, far = (-b - root) / a, (-b + root) / a
    if near > far:
        near, far = far, near
    near_ok, far_ok = wa + near * da > 0.0, wa + far * da > 0.0
    if near_ok and far_ok:
        return float(near if side > 0 else far)
    if near_ok:
        return float(near)
    return far if far_ok else np.nan


@compiled
def _depth_on_quadric(th: Array, wx: float, wy: float, wz: float, dx: float, dy: float) -> float:
    """Return the depth at which a ray meets a quadric; w is its origin minus the centre, (dx, dy, 1) its direction."""
    s = 1.0 / th[3]
    wx, wy, wz, dx, dy, dz = wx * s, wy * s, wz * s, dx * s, dy * s, s
    # u and v are half the gradients of the quadratic part at d and at w.
    ux, vx = th[4] * dx + 0.5 * (th[7] * dy + th[8] * dz), th[4] * wx + 0.5 * (th[7] * wy + th[8] * wz)
    uy, vy = th[5] * dy + 0.5 * (th[7] * dx + th[9] * dz), th[5] * wy + 0.5 * (th[7] * wx + th[9] * wz)
    uz, vz = th[6] * dz + 0.5 * (th[8] * dx + th[9] * dy), th[6] * wz + 0.5 * (th[8] * wx + th[9] * wy)
    b = ux * wx + uy * wy + uz * wz + 0.5 * (th[10] * dx + th[11] * dy + th[12] * dz)
    c = (vx + th[10]) * wx + (vy + th[11]) * wy + (vz + th[12]) * wz + th[13]
    return _roots(ux * dx + uy * dy + uz * dz, b, c, 1.0)


@compiled
def normal_on(kind: int, th: Array, px: float, py: float, pz: float) -> tuple[float, float, float]:
    """Return the unit gradient of the surface at a point on it; it is not turned towards the sensor."""
    if kind == PLANE:
        return th[0], th[1], th[2]
    wx, wy, wz = px - th[0], py - th[1], pz - th[2]
    if kind == SPHERE:
        gx, gy, gz = wx, wy, wz
    elif kind == CYLINDER or kind == CONE:
        h = wx * th[3] + wy * th[4] + wz * th[5]
        gx, gy, gz = wx - h * th[3], wy - h * th[4], wz - h * th[5]
        if kind == CONE:
            n = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30
            ca, sa = np.cos(th[6]), np.sin(th[6])
            gx, gy, gz = ca * gx / n - sa * th[3], ca * gy / n - sa * th[4], ca * gz / n - sa * th[5]
    else:
        inverse = 1.0 / th[3]
        wx, wy, wz = wx * inverse, wy * inverse, wz * inverse
        gx = 2.0 * th[4] * wx + th[7] * wy + th[8] * wz + th[10]
        gy = 2.0 * th[5] * wy + th[7] * wx + th[9] * wz + th[11]
        gz = 2.0 * th[6] * wz + th[8] * wx + th[9] * wy + th[12]
    n = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30
    return gx / n, gy / n, gz / n


@compiled
def normals_on(kind: int, th: Array, x: Array, y: Array, z: Array, perspective: bool, out: Array) -> None:
    """Write the unit normals at the rays (x, y) and depths z (N,), turned towards the sensor, into `out` (N, 3)."""
    for i in range(x.shape[0]):
        px, py = (x[i] * z[i], y[i] * z[i]) if perspective else (x[i], y[i])
        nx, ny, nz = normal_on(kind, th, px, py, z[i])
        facing = nx * x[i] + ny * y[i] + nz if perspective else nz
        side = -1.0 if facing > 0.0 else 1.0
        out[i, 0], out[i, 1], out[i, 2] = side * nx, side * ny, side * nz


@compiled
def frame_of(kind: int, th: Array, frame: Array) -> None:
    """Fill `frame` (6,) with the two tangent vectors in which steps of this surface are expressed."""
    if kind == PLANE:
        f = tangent_frame(th[0], th[1], th[2])
    elif kind == CYLINDER or kind == CONE:
        f = tangent_frame(th[3], th[4], th[5])
    else:
        f = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    for i in range(6):
        frame[i] = f[i]


@compiled
def step_into(kind: int, th: Array, frame: Array, step: Array, out: Array) -> None:
    """Write the parameters after a step (9,) of the tangent parameters into `out` (16,).

    Unit vectors remain unit vectors, and a quadric keeps the trace of its matrix.
    """
    for i in range(SIZE):
        out[i] = th[i]
    if kind == PLANE or kind == CYLINDER or kind == CONE:
        at, t1, t2 = (0, step[0], step[1]) if kind == PLANE else (3, step[2], step[3])
        if kind == CONE:
            t1, t2 = step[3], step[4]
        n = 0.0
        for i in range(3):
            out[at + i] = th[at + i] + t1 * frame[i] + t2 * frame[3 + i]
            n += out[at + i] ** 2
        n = np.sqrt(n)
        for i in range(3):
            out[at + i] /= n
    if kind == PLANE:
        out[3] += step[2]
    elif kind == SPHERE:
        for i in range(4):
            out[i] += step[i]
        out[3] = abs(out[3])
    elif kind == CYLINDER:
        for i in range(3):
            out[i] += step[0] * frame[i] + step[1] * frame[3 + i]
        out[6] = abs(out[6] + step[4])
    elif kind == CONE:
        for i in range(3):
            out[i] += step[i]
        out[6] = min(max(out[6] + step[5], 1e-3), 1.55)
    else:
        out[4] += step[0]
        out[5] += step[1]
        out[6] -= step[0] + step[1]
        for i in range(7):
            out[7 + i] += step[2 + i]
