"""Tangent planes of all blocks of a grid, a run of blocks at a time.

A run is worked on in rows of one scratch array at fixed places, and the loops hold no branch: only so does the compiler
prove that nothing overlaps, and turn four blocks into one instruction. The neighbours of a run lie in rows that are wider
by the window, so that each row of blocks is fetched once for all shifts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.fitting.surfaces import LEAN

JUMP_SIGMAS = 4.0
LEAST_SHARE = 0.4  # of the window's blocks must lie on the surface
TURN_RAD = 0.15  # between neighbouring blocks of one face
WINDOW_BEND = 0.0745 * TURN_RAD  # rms of a parabola that turns so far over twice a length, by that length
LEAST_FACING = 0.15  # beyond, normals are not known well enough
STEADY_RMS = 1.8  # what a tangent plane leaves over in sigmas, beyond which the block holds a crease or noise
GAP = 8  # empty blocks that end a run
RUN = 128  # blocks at most
X0, Y0, Z0, G0, BASE, SLOPE = (row * RUN for row in range(6))  # where the rows of the run's own blocks begin
N, S, SX, SY, SG, SXX, SXY, SYY, SXG, SYG, SGG = (row * RUN for row in range(6, 17))  # sums over its neighbours
NX, NY, NZ, RMS = (row * RUN for row in range(17, 21))  # the planes
SCRATCH = 21 * RUN
WIDE = RUN + 16  # a row of neighbours: room for a radius of eight blocks
X, Y, Z, G, K = (row * WIDE for row in range(5))


@njit(cache=True, nogil=True, error_model="numpy")
def tangent_planes(  # type: ignore[no-untyped-def]  # numba types it
    x, y, z, count, sigma, perspective, radius, slope_per_block, normal, rms, top, bottom
):
    """Plane of least squares through the blocks around each block, within a jump of it; writes rows [top, bottom).

    Args:
        x, y, z, count, sigma: (h, w) as in `Grid`, NaN depth where a block is empty; `count` weighs a block.
        radius: of the window in blocks.
        slope_per_block: metres of depth per block (and per metre of depth, if perspective) that are no jump yet.
        normal, rms: (h, w, 3) and (h, w) outputs, filled with NaN; left so where no plane is determined.
    """
    h, w = z.shape
    least = max(5.0, np.floor((2 * radius + 1) ** 2 * LEAST_SHARE))
    work, wide = np.zeros(SCRATCH), np.empty(5 * WIDE)
    for r in range(top, bottom):
        start, end = _next_run(z[r], 0)
        while start < w:
            n = end - start
            work[N:NX] = 0.0
            _load_own(x[r, start:end], y[r, start:end], z[r, start:end], sigma[r, start:end], perspective, work)
            a, b = max(start - radius, 0), min(end + radius, w)
            for i in range(max(0, r - radius), min(h, r + radius + 1)):
                wide[Z : G + WIDE] = np.nan  # beyond the image there is no neighbour
                _load(x[i, a:b], y[i, a:b], z[i, a:b], count[i, a:b], perspective, a - start + radius, wide)
                for shift in range(-radius, radius + 1):
                    _add(slope_per_block * max(abs(i - r), abs(shift)), n, radius + shift, wide, work)
            _solve(n, least, perspective, work)
            _store(normal[r, start:end], rms[r, start:end], work)
            start, end = _next_run(z[r], end)


@njit(cache=True, error_model="numpy", **LEAN)
def _next_run(z, start):  # type: ignore[no-untyped-def]  # numba types it
    """[start, end) of the next run of known depths that no gap of `GAP` empty blocks parts; (w, w) when there is none."""
    w = z.shape[0]
    while start < w and not np.isfinite(z[start]):
        start += 1
    end, last = start, start
    while end < w and end - last < GAP and end - start < RUN:
        if np.isfinite(z[end]):
            last = end
        end += 1
    return start, min(last + 1, w)


@njit(cache=True, error_model="numpy", **LEAN)
def _load_own(x, y, z, sigma, perspective, work):  # type: ignore[no-untyped-def]  # numba types it
    n = x.shape[0]
    for c in range(n):
        work[X0 + c], work[Y0 + c], work[Z0 + c] = x[c], y[c], z[c]
        work[G0 + c] = 1.0 / z[c] if perspective else z[c]
        work[BASE + c] = JUMP_SIGMAS * sigma[c]
        work[SLOPE + c] = z[c] if perspective else 1.0


@njit(cache=True, error_model="numpy", **LEAN)
def _load(x, y, z, count, perspective, at, wide):  # type: ignore[no-untyped-def]  # numba types it
    """One row of neighbours into `wide`, the first at `at`."""
    n = x.shape[0]
    to_x, to_y, to_z, to_g, to_k = wide[X + at :], wide[Y + at :], wide[Z + at :], wide[G + at :], wide[K + at :]
    for c in range(n):
        to_x[c] = x[c]
    for c in range(n):
        to_y[c] = y[c]
    for c in range(n):
        to_z[c] = z[c]
    for c in range(n):
        to_k[c] = count[c]
    if perspective:
        for c in range(n):
            to_g[c] = 1.0 / z[c]
    else:
        for c in range(n):
            to_g[c] = z[c]


@njit(cache=True, error_model="numpy", **LEAN)
def _add(reach, n, at, wide, work):  # type: ignore[no-untyped-def]  # numba types it
    """Sums of 1, k, and k times x, y, g, xx, xy, yy, xg, yg, gg over one neighbour of every block, if it is near.

    The neighbour of the first block is the one at `at` of the rows of `wide`.
    """
    x, y, z, g, count = wide[X + at :], wide[Y + at :], wide[Z + at :], wide[G + at :], wide[K + at :]
    for c in range(n):
        near = abs(z[c] - work[Z0 + c]) <= work[BASE + c] + work[SLOPE + c] * reach  # refuses NaN
        k = count[c] if near else 0.0
        dg = g[c] - work[G0 + c] if near else 0.0
        dx = x[c] - work[X0 + c] if near else 0.0
        dy = y[c] - work[Y0 + c] if near else 0.0
        kx, ky, kg = k * dx, k * dy, k * dg
        work[N + c] += 1.0 if near else 0.0
        work[S + c] += k
        work[SX + c] += kx
        work[SY + c] += ky
        work[SG + c] += kg
        work[SXX + c] += kx * dx
        work[SXY + c] += kx * dy
        work[SYY + c] += ky * dy
        work[SXG + c] += kx * dg
        work[SYG + c] += ky * dg
        work[SGG + c] += kg * dg


@njit(cache=True, error_model="numpy", **LEAN)
def _solve(n, least, perspective, work):  # type: ignore[no-untyped-def]  # numba types it
    """Rows of the plane's normal towards the sensor and of what it leaves over in sigmas; NaN where it is not determined.

    The window's sums, centred, give the slopes (p, q) of g.
    """
    p = 1.0 if perspective else 0.0
    for c in range(n):
        blocks, sx, sy, sg = work[N + c], work[SX + c], work[SY + c], work[SG + c]
        per = 1.0 / work[S + c]
        sxx, sxy = work[SXX + c] - sx * sx * per, work[SXY + c] - sx * sy * per
        syy, sxg = work[SYY + c] - sy * sy * per, work[SXG + c] - sx * sg * per
        syg, sgg = work[SYG + c] - sy * sg * per, work[SGG + c] - sg * sg * per
        det = sxx * syy - sxy * sxy
        ok = (blocks >= least) & (det > 1e-4 * sxx * syy) & (det > 0.0)
        per_det = 1.0 / det
        a, b = (syy * sxg - sxy * syg) * per_det, (sxx * syg - sxy * sxg) * per_det
        left = max(sgg - a * sxg - b * syg, 0.0) * per * blocks / max(blocks - 3.0, 1.0)
        # g = a x + b y + c is the plane (a, b, c) . X = 1 seen in perspective, else (-a, -b, 1) . X = c.
        x0, y0, z0 = work[X0 + c], work[Y0 + c], work[Z0 + c]
        nz = work[G0 + c] + (sg - a * sx - b * sy) * per - a * x0 - b * y0 if perspective else 1.0
        nx, ny = (a, b) if perspective else (-a, -b)
        facing = p * (nx * x0 + ny * y0) + nz
        inverse = (-1.0 if facing > 0.0 else 1.0) / np.sqrt(nx * nx + ny * ny + nz * nz)
        scale = z0 * z0 if perspective else 1.0
        work[NX + c] = nx * inverse if ok else np.nan
        work[NY + c], work[NZ + c] = ny * inverse, nz * inverse
        work[RMS + c] = np.sqrt(left) * scale * JUMP_SIGMAS / work[BASE + c]


@njit(cache=True, error_model="numpy", **LEAN)
def _store(normal, rms, work):  # type: ignore[no-untyped-def]  # numba types it
    for c in range(rms.shape[0]):
        if np.isfinite(work[NX + c]):
            normal[c, 0], normal[c, 1], normal[c, 2] = work[NX + c], work[NY + c], work[NZ + c]
            rms[c] = work[RMS + c]


@njit(cache=True, nogil=True, error_model="numpy")
def bent_planes(x, y, z, count, sigma, perspective, radius, slope_per_block, normal, rms):  # type: ignore[no-untyped-def]  # numba types it
    """Tangent planes as a face's may be that bends or is steeper than a jump; changes `normal` and `rms` in place.

    What planes leave over is told in units of what a face may bend within their window, where that is more than steady
    noise. Where `tangent_planes` found none, steeper neighbours count too: what lies on both sides of a jump is no
    plane, so only one that leaves no more over than noise and bend is kept. Arguments as there.
    """
    h, w = z.shape
    half = (radius + 0.5) * abs(x[0, 1] - x[0, 0])
    work = np.zeros(SCRATCH)
    for r in range(h):
        for c in range(w):
            if rms[r, c] < STEADY_RMS or not np.isfinite(z[r, c]):
                continue
            length = half * z[r, c] if perspective else half
            if np.isfinite(rms[r, c]):
                rms[r, c] = _beyond_bend(rms[r, c], normal[r, c], x[r, c], y[r, c], sigma[r, c], perspective, length)
                continue
            _fit_steep(x, y, z, count, sigma, perspective, radius, slope_per_block, r, c, work)
            work[RMS] = _beyond_bend(work[RMS], work[NX:RMS:RUN], x[r, c], y[r, c], sigma[r, c], perspective, length)
            if work[RMS] < STEADY_RMS:
                _store(normal[r, c : c + 1], rms[r, c : c + 1], work)


@njit(cache=True, error_model="numpy", **LEAN)
def _beyond_bend(rms, n, x, y, sigma, perspective, length):  # type: ignore[no-untyped-def]  # numba types it
    """`rms` in units of the bend that a face with normal `n` may have within a window that is twice `length` metres wide.

    A slanted face bends more for the same curvature: the window is longer on it, and depth runs along the ray.
    """
    facing = n[0] * x + n[1] * y + n[2] if perspective else n[2]
    bend = WINDOW_BEND * length / max(facing * facing, LEAST_FACING**2)
    return rms / max(1.0, bend / (STEADY_RMS * sigma))


@njit(cache=True, error_model="numpy")
def _fit_steep(x, y, z, count, sigma, perspective, radius, slope_per_block, r, c, work):  # type: ignore[no-untyped-def]  # numba types it
    """The plane of one block, into the first places of `work`."""
    h, w = z.shape
    work[N:NX] = 0.0
    _load_own(x[r, c : c + 1], y[r, c : c + 1], z[r, c : c + 1], sigma[r, c : c + 1], perspective, work)
    for i in range(max(0, r - radius), min(h, r + radius + 1)):
        for j in range(max(0, c - radius), min(w, c + radius + 1)):
            reach = work[BASE] + work[SLOPE] * slope_per_block * max(abs(i - r), abs(j - c))
            if abs(z[i, j] - z[r, c]) <= reach:
                g = 1.0 / z[i, j] if perspective else z[i, j]
                _add_one(count[i, j], x[i, j] - x[r, c], y[i, j] - y[r, c], g - work[G0], work)
    _solve(1, max(5.0, np.floor((2 * radius + 1) ** 2 * LEAST_SHARE)), perspective, work)


@njit(cache=True, error_model="numpy", **LEAN)
def _add_one(k, dx, dy, dg, work):  # type: ignore[no-untyped-def]  # numba types it
    """One neighbour into the sums of the first block."""
    work[N] += 1.0
    work[S] += k
    work[SX] += k * dx
    work[SY] += k * dy
    work[SG] += k * dg
    work[SXX] += k * dx * dx
    work[SXY] += k * dx * dy
    work[SYY] += k * dy * dy
    work[SXG] += k * dx * dg
    work[SYG] += k * dy * dg
    work[SGG] += k * dg * dg
