"""Tangent planes of all blocks of a grid, computed in runs of blocks.

A run is a sequence of blocks in one row of the grid. The quantities of a run (one row of numbers each) are at fixed
offsets in one scratch array, and the loops have no branch. Only then can the compiler prove that nothing overlaps, and
process four blocks with one instruction. The neighbours of a run are held in longer rows, which include the window's
margin, so that each row of blocks is loaded once for all shifts.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels
from hal.jit import as_numpy_scalar, compiled

JUMP_SIGMAS = 4.0  # noise allowed in a depth step that is not a jump
LEAST_SHARE = 0.4  # least share of the window's blocks that no jump separates from the middle block
TURN_RAD = 0.15  # between neighbouring blocks of one face
LEAST_FACING = 0.15  # below this cosine of incidence normals are too inaccurate
STEADY_RMS = 1.8  # sigmas; a tangent plane with larger residuals lies on a crease or in noise
GAP = 8  # number of successive empty blocks that end a run
FIRST = as_numpy_scalar(0)
RUN = 128  # largest number of blocks in a run
# Where the rows of the scratch array begin: the run's own blocks, the sums over their neighbours, and the planes.
X0, Y0, Z0, G0, BASE, SLOPE = (row * RUN for row in range(6))
N, S, SX, SY, SG, SXX, SXY, SYY, SXG, SYG, SGG = (row * RUN for row in range(6, 17))
NX, NY, NZ, RMS = (row * RUN for row in range(17, 21))
SCRATCH = 21 * RUN
WIDE = RUN + 16  # length of a row of neighbours: room for a radius of eight blocks
X, Y, Z, G, K = (row * WIDE for row in range(5))  # where the rows of neighbours begin; g is 1 / z or z, k the weight


@compiled
def tangent_planes(
    x: Array, y: Array, z: Array, count: Labels, sigma: Array, perspective: bool, radius: int, slope_per_block: float,
    normal: Array, rms: Array, top: int, bottom: int,
) -> None:  # fmt: skip
    """Fit a plane to those blocks around each block that no depth jump separates from it; writes rows [top, bottom).

    Args:
        x, y, z, count, sigma: (h, w) as in `Grid`, NaN depth where a block is empty; `count` is the weight of a block.
        radius: of the window in blocks.
        slope_per_block: largest step that is not a jump, in metres per block (and per metre of depth, if perspective).
        normal, rms: (h, w, 3) and (h, w) outputs, initially NaN; they stay NaN where no plane is determined.
    """
    h, w = z.shape
    least = max(5.0, np.floor((2 * radius + 1) ** 2 * LEAST_SHARE))
    work, wide = np.zeros(SCRATCH), np.empty(5 * WIDE)
    for r in range(top, bottom):
        start, end = _next_run(z[r], FIRST)
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


@compiled
def _next_run(z: Array, start: int) -> tuple[int, int]:
    """Return [start, end) of the next run of known depths, from `start` on; (w, w) if there is none.

    A run has at most `RUN` blocks and no gap of `GAP` empty ones.
    """
    w = z.shape[0]
    while start < w and not np.isfinite(z[start]):
        start += 1
    end, last = start, start
    while end < w and end - last < GAP and end - start < RUN:
        if np.isfinite(z[end]):
            last = end
        end += 1
    return start, min(last + 1, w)


@compiled
def _load_own(x: Array, y: Array, z: Array, sigma: Array, perspective: bool, work: Array) -> None:
    """Load the blocks of the run into `work`, and from which depth step on a neighbour of each is beyond a jump."""
    n = x.shape[0]
    for c in range(n):
        work[X0 + c], work[Y0 + c], work[Z0 + c] = x[c], y[c], z[c]
        work[G0 + c] = 1.0 / z[c] if perspective else z[c]
        work[BASE + c] = JUMP_SIGMAS * sigma[c]
        work[SLOPE + c] = z[c] if perspective else 1.0


@compiled
def _load(x: Array, y: Array, z: Array, count: Labels, perspective: bool, at: int, wide: Array) -> None:
    """Load one row of neighbours into `wide`, the first at offset `at`."""
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


@compiled
def _add(reach: float, n: int, at: int, wide: Array, work: Array) -> None:
    """Add one neighbour of every block, if no jump separates them, to the block's sums.

    These are the sums of 1, k, and k times x, y, g, xx, xy, yy, xg, yg, gg, where k is the neighbour's weight and x, y, g
    are relative to the block. The neighbour of the first block is at offset `at` in the rows of `wide`. `reach`: largest
    step that is not a jump at a unit depth, without noise.
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


@compiled
def _solve(n: int, least: float, perspective: bool, work: Array) -> None:
    """Compute the normals of the planes, towards the sensor, and their rms residuals in sigmas; NaN if not determined.

    The plane g = a x + b y + c of each window follows by linear least squares from its sums.
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


@compiled
def _store(normal: Array, rms: Array, work: Array) -> None:
    """Copy the normals and residuals of the run into the outputs where a plane is determined."""
    for c in range(rms.shape[0]):
        if np.isfinite(work[NX + c]):
            normal[c, 0], normal[c, 1], normal[c, 2] = work[NX + c], work[NY + c], work[NZ + c]
            rms[c] = work[RMS + c]
