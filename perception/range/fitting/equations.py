"""Residuals of rays against one surface, their robust weights, and the normal equations of a Gauss-Newton step.

The rows of `rays` hold the samples, the depths of the surface and the derivatives. Everything here works on one chunk
of them at a time, without a branch in the loops.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import REORDERED, compiled
from perception.range.fitting.rays import (
    CHUNK,
    COSINE,
    D0,
    DEPTH,
    ERROR,
    FILLED,
    NOTHING,
    RESIDUAL,
    SCRATCH,
    SIGMA,
    WEIGHT,
    Z,
    fill_rows,
    load_rows,
)
from perception.range.fitting.surfaces import FREEDOM, GRAZING_COSINE, frame_of

LANES = 16  # rows are padded with zeros to a multiple of this, so that sums need no remainder loop
MISS_SIGMAS = 6.0  # a ray that misses the surface costs as much as a residual of this size
CAUCHY_WIDTH = 2.0
FARTHEST = 1e15  # sigmas; the product of eight of its squares is still finite


@compiled(fastmath=REORDERED)
def error_row(n: int, work: Array) -> None:
    """Fill row ERROR from the filled rows: residuals in sigmas, reduced at grazing rays; NaN where a ray misses."""
    for i in range(n):
        w = min(1.0, work[COSINE + i] * (1.0 / GRAZING_COSINE)) / work[SIGMA + i]
        work[ERROR + i] = (work[Z + i] - work[DEPTH + i]) * w


@compiled(fastmath=REORDERED)
def _cauchy_weights(n: int, c2: float, work: Array) -> float:
    """Fill rows WEIGHT and RESIDUAL for Cauchy weights of squared width `c2`; returns the number of rays that hit.

    Row DEPTH becomes 1 + e^2 / c2, whose logarithm is the cost of the sample.
    """
    used = 0.0
    for i in range(n):
        zm = work[DEPTH + i]
        w = min(1.0, work[COSINE + i] * (1.0 / GRAZING_COSINE)) / work[SIGMA + i]
        e = (work[Z + i] - zm) * w
        work[ERROR + i] = e
        hit = abs(e) < FARTHEST
        e2 = e * e if hit else MISS_SIGMAS * MISS_SIGMAS
        ratio = 1.0 + e2 / c2
        root = 1.0 / np.sqrt(ratio)
        work[DEPTH + i] = ratio
        work[WEIGHT + i] = root * w if hit else 0.0
        work[RESIDUAL + i] = root * e if hit else 0.0
        used += 1.0 if hit else 0.0
    return used


@compiled(fastmath=REORDERED)
def _sum_of_logarithms(values: Array) -> float:
    """Return the sum of ln(values), with one logarithm per product of eight values because logarithms are slow."""
    total = 0.0
    n = values.shape[0]
    whole = n // 8 * 8
    for i in range(0, whole, 8):
        v = values[i : i + 8]
        total += np.log(((v[0] * v[1]) * (v[2] * v[3])) * ((v[4] * v[5]) * (v[6] * v[7])))
    for i in range(whole, n):
        total += np.log(values[i])
    return total


@compiled(fastmath=REORDERED)
def _trim_weights(n: int, trim: float, work: Array) -> tuple[float, float]:
    """Fill rows WEIGHT and RESIDUAL with samples beyond `trim` sigmas left out; returns cost and number kept."""
    used, cost = 0.0, 0.0
    for i in range(n):
        zm = work[DEPTH + i]
        w = min(1.0, work[COSINE + i] * (1.0 / GRAZING_COSINE)) / work[SIGMA + i]
        e = (work[Z + i] - zm) * w
        work[ERROR + i] = e
        kept = abs(e) <= trim
        cost += e * e if kept else trim * trim
        work[WEIGHT + i] = w if kept else 0.0
        work[RESIDUAL + i] = e if kept else 0.0
        used += 1.0 if kept else 0.0
    return cost, used


@compiled(fastmath=REORDERED)
def _dot(a: Array, b: Array) -> float:
    """Return the dot product of two rows; the compiler may change the order of summation."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@compiled(fastmath=REORDERED)
def _weighted(row: Array, weight: Array) -> None:
    """Multiply `row` by `weight` in place; samples without weight become 0, even if they are NaN."""
    for i in range(row.shape[0]):
        row[i] = row[i] * weight[i] if weight[i] > 0.0 else 0.0


@compiled
def _add_products(p: int, n: int, work: Array, H: Array, g: Array) -> None:
    """Add J'W^2 J to the lower triangle of `H` and J'W e to `g` from the rows of one chunk.

    J: derivatives of depth, W: row WEIGHT, e: row RESIDUAL, which is already weighted.
    """
    padded = (n + LANES - 1) // LANES * LANES
    work[WEIGHT + n : WEIGHT + padded] = 0.0
    work[RESIDUAL + n : RESIDUAL + padded] = 0.0
    weight, e = work[WEIGHT : WEIGHT + padded], work[RESIDUAL : RESIDUAL + padded]
    for a in range(p):
        mine = work[D0 + a * CHUNK : D0 + a * CHUNK + padded]
        _weighted(mine, weight)
        g[a] += _dot(mine, e)
        for b in range(a + 1):
            H[a, b] += _dot(mine, work[D0 + b * CHUNK : D0 + b * CHUNK + padded])


@compiled
def normal_equations(
    kind: int, th: Array, frame: Array, x: Array, y: Array, z: Array, sigma: Array, perspective: bool, scale: float,
    trim: float, H: Array, g: Array, work: Array, held: int, step_follows: bool,
) -> tuple[float, int]:  # fmt: skip
    """Compute Gauss-Newton matrix `H` (9, 9) and gradient `g` (9,) of the ray residuals; returns cost and samples used.

    Args:
        x, y, z, sigma: (N,) samples; coordinates as in `Grid`.
        scale: > 0: width of the Cauchy weights in sigmas; 0: samples beyond `trim` sigmas are left out.
        held: which rows of `work` are already valid, for at most CHUNK samples (NOTHING, LOADED, ERRED or FILLED);
            afterwards the samples and row ERROR are.
        step_follows: whether `H` and `g` are needed; without it they are zero.
    """
    H[:] = 0.0
    g[:] = 0.0
    cost, used = 0.0, 0.0
    count = x.shape[0]
    for first in range(0, count, CHUNK):
        n = min(CHUNK, count - first)
        if held == NOTHING:
            load_rows(x, y, z, sigma, first, n, work)
        if held != FILLED:
            fill_rows(kind, th, frame, n, perspective, work)
        more, hits = _weigh(n, scale, trim, work)
        if step_follows:
            _add_products(FREEDOM[kind], n, work, H, g)
        cost += more
        used += hits
    mirror(FREEDOM[kind], H)
    return cost, int(used)


@compiled
def add_equations(kind: int, n: int, scale: float, trim: float, work: Array, H: Array, g: Array) -> tuple[float, float]:
    """Add the `n` filled rays in `work` to the lower triangle of `H` and to `g`; returns cost and number of rays used."""
    cost, used = _weigh(n, scale, trim, work)
    _add_products(FREEDOM[kind], n, work, H, g)
    return cost, used


@compiled
def _weigh(n: int, scale: float, trim: float, work: Array) -> tuple[float, float]:
    """Fill rows WEIGHT and RESIDUAL of the `n` filled rays in `work`; returns cost and number of rays used."""
    if scale > 0.0:
        c2 = scale * scale * CAUCHY_WIDTH * CAUCHY_WIDTH
        used = _cauchy_weights(n, c2, work)
        return c2 * _sum_of_logarithms(work[:n]), used
    return _trim_weights(n, trim, work)


@compiled
def mirror(p: int, H: Array) -> None:
    """Fill the upper triangle of the first p rows of `H` from the lower one."""
    for a in range(p):
        for b in range(a):
            H[b, a] = H[a, b]


@compiled
def residuals(kind: int, th: Array, x: Array, y: Array, z: Array, sigma: Array, perspective: bool, out: Array) -> None:
    """Fill `out` (N,) with residuals in sigmas, reduced at grazing rays; NaN where the ray misses."""
    residuals_by_chunks(kind, th, x, y, z, sigma, perspective, np.empty(6), np.empty(SCRATCH), out)


@compiled
def residuals_by_chunks(
    kind: int, th: Array, x: Array, y: Array, z: Array, sigma: Array, perspective: bool, frame: Array, work: Array,
    out: Array,
) -> None:  # fmt: skip
    """Compute `residuals` with the work arrays `frame` (6,) and `work` (SCRATCH,), which are overwritten."""
    frame_of(kind, th, frame)
    count = x.shape[0]
    for first in range(0, count, CHUNK):
        n = min(CHUNK, count - first)
        load_rows(x, y, z, sigma, first, n, work)
        fill_rows(kind, th, frame, n, perspective, work)
        error_row(n, work)
        for i in range(n):
            out[first + i] = work[ERROR + i]
