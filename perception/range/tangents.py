"""Tangent planes of all blocks of a grid, a run of blocks at a time.

A run is worked on in rows of one scratch array at fixed places, and the loops hold no branch: only so does the compiler
prove that nothing overlaps, and turn four blocks into one instruction.
"""

from __future__ import annotations

import numpy as np
from numba import njit

JUMP_SIGMAS = 4.0
LEAST_SHARE = 0.4  # of the window's blocks must lie on the surface
GAP = 8  # empty blocks that end a run
RUN = 128  # blocks at most
X0, Y0, Z0, G0, BASE, SLOPE, X, Y, Z, G, K, SUMS = range(12)  # rows of the scratch array; SUMS is the first of eleven
SCRATCH = (SUMS + 11) * RUN


@njit(cache=True, nogil=True, error_model="numpy")
def tangent_planes(  # type: ignore[no-untyped-def]
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
    work = np.zeros(SCRATCH)
    for r in range(top, bottom):
        start, end = _next_run(z[r], 0)
        while start < w:
            n = end - start
            work[SUMS * RUN :] = 0.0
            _load_own(x[r, start:end], y[r, start:end], z[r, start:end], sigma[r, start:end], perspective, work)
            for i in range(max(0, r - radius), min(h, r + radius + 1)):
                for shift in range(-radius, radius + 1):
                    a, b = max(start + shift, 0), min(end + shift, w)
                    work[Z * RUN : G * RUN] = np.nan  # beyond the image there is no neighbour
                    at = a - start - shift
                    _load(x[i, a:b], y[i, a:b], z[i, a:b], count[i, a:b], perspective, at, work)
                    _add(slope_per_block * max(abs(i - r), abs(shift)), n, work)
            _solve(n, least, perspective, sigma[r, start:end], normal[r, start:end], rms[r, start:end], work)
            start, end = _next_run(z[r], end)


@njit(cache=True, error_model="numpy")
def _next_run(z, start):  # type: ignore[no-untyped-def]
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


@njit(cache=True, error_model="numpy")
def _load_own(x, y, z, sigma, perspective, work):  # type: ignore[no-untyped-def]
    n = x.shape[0]
    work[X0 * RUN : X0 * RUN + n] = x
    work[Y0 * RUN : Y0 * RUN + n] = y
    work[Z0 * RUN : Z0 * RUN + n] = z
    work[G0 * RUN : G0 * RUN + n] = 1.0 / z if perspective else z
    work[BASE * RUN : BASE * RUN + n] = JUMP_SIGMAS * sigma
    work[SLOPE * RUN : SLOPE * RUN + n] = z if perspective else np.ones(n)


@njit(cache=True, error_model="numpy")
def _load(x, y, z, count, perspective, at, work):  # type: ignore[no-untyped-def]
    n = x.shape[0]
    for c in range(n):
        work[X * RUN + at + c] = x[c]
    for c in range(n):
        work[Y * RUN + at + c] = y[c]
    for c in range(n):
        work[Z * RUN + at + c] = z[c]
    for c in range(n):
        work[K * RUN + at + c] = count[c]
    if perspective:
        for c in range(n):
            work[G * RUN + at + c] = 1.0 / z[c]
    else:
        for c in range(n):
            work[G * RUN + at + c] = z[c]


@njit(cache=True, error_model="numpy")
def _add(reach, n, work):  # type: ignore[no-untyped-def]
    """Sums of 1, k, and k times x, y, g, xx, xy, yy, xg, yg, gg over one neighbour of every block, if it is near."""
    for c in range(n):
        near = abs(work[1024 + c] - work[256 + c]) <= work[512 + c] + work[640 + c] * reach  # refuses NaN
        k = work[1280 + c] if near else 0.0
        dg = work[1152 + c] - work[384 + c] if near else 0.0
        dx, dy = work[768 + c] - work[c], work[896 + c] - work[128 + c]
        kx, ky, kg = k * dx, k * dy, k * dg
        work[1408 + c] += 1.0 if near else 0.0
        work[1536 + c] += k
        work[1664 + c] += kx
        work[1792 + c] += ky
        work[1920 + c] += kg
        work[2048 + c] += kx * dx
        work[2176 + c] += kx * dy
        work[2304 + c] += ky * dy
        work[2432 + c] += kx * dg
        work[2560 + c] += ky * dg
        work[2688 + c] += kg * dg


@njit(cache=True, error_model="numpy")
def _solve(n, least, perspective, sigma, normal, rms, work):  # type: ignore[no-untyped-def]
    """Slopes (p, q) of g over the window, the plane's normal towards the sensor, and what it leaves over in sigmas."""
    for c in range(n):
        blocks, s, sx, sy, sg = work[1408 + c], work[1536 + c], work[1664 + c], work[1792 + c], work[1920 + c]
        sxx, sxy = work[2048 + c] - sx * sx / s, work[2176 + c] - sx * sy / s
        syy, sxg = work[2304 + c] - sy * sy / s, work[2432 + c] - sx * sg / s
        syg, sgg = work[2560 + c] - sy * sg / s, work[2688 + c] - sg * sg / s
        det = sxx * syy - sxy * sxy
        if not (blocks >= least and det > 1e-4 * sxx * syy and det > 0.0):
            continue
        p, q = (syy * sxg - sxy * syg) / det, (sxx * syg - sxy * sxg) / det
        left = max(sgg - p * sxg - q * syg, 0.0) / s * blocks / max(blocks - 3.0, 1.0)
        if perspective:
            # g = p x + q y + c is the plane (p, q, c) . X = 1
            x0, y0, z0 = work[c], work[128 + c], work[256 + c]
            nx, ny, nz = p, q, work[384 + c] + (sg - p * sx - q * sy) / s - p * x0 - q * y0
            facing, scale = nx * x0 + ny * y0 + nz, z0 * z0
        else:
            nx, ny, nz, facing, scale = -p, -q, 1.0, 1.0, 1.0
        rms[c] = np.sqrt(left) * scale / sigma[c]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        inverse = -1.0 / length if facing > 0.0 else 1.0 / length
        normal[c, 0], normal[c, 1], normal[c, 2] = nx * inverse, ny * inverse, nz * inverse
