"""Residuals of rays against one surface, their robust weights, and the normal equations of a Gauss-Newton step.

The rows of `rays` hold the samples, the depths of the surface and the derivatives. The loops have no branch.
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
TRIM_SIGMAS = 3.0  # samples with larger residuals are outliers in the final least squares
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
def _trim_weights(n: int, work: Array) -> tuple[float, float]:
    """Fill rows WEIGHT and RESIDUAL with samples beyond the trim left out; returns cost and number kept."""
    used, cost = 0.0, 0.0
    for i in range(n):
        zm = work[DEPTH + i]
        w = min(1.0, work[COSINE + i] * (1.0 / GRAZING_COSINE)) / work[SIGMA + i]
        e = (work[Z + i] - zm) * w
        work[ERROR + i] = e
        kept = abs(e) <= TRIM_SIGMAS
        cost += e * e if kept else TRIM_SIGMAS * TRIM_SIGMAS
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
def add_equations(
    kind: int, n: int, scale: float, work: Array, H: Array, g: Array, step_follows: bool,
) -> tuple[float, float]:  # fmt: skip
    """Add the `n` filled rays in `work` to a Gauss-Newton system; returns their cost and the number of rays used.

    J'W^2 J is added to the lower triangle of `H` (9, 9) and J'W e to `g` (9,), unless no step follows. J: derivatives of
    depth, W: row WEIGHT, e: row RESIDUAL, which is already weighted. `scale` > 0: width of the Cauchy weights in sigmas;
    0: samples beyond the trim are left out.
    """
    if scale > 0.0:
        c2 = scale * scale * CAUCHY_WIDTH * CAUCHY_WIDTH
        used = _cauchy_weights(n, c2, work)
        cost = c2 * _sum_of_logarithms(work[:n])
    else:
        cost, used = _trim_weights(n, work)
    if not step_follows:
        return cost, used
    padded = (n + LANES - 1) // LANES * LANES
    work[WEIGHT + n : WEIGHT + padded] = 0.0
    work[RESIDUAL + n : RESIDUAL + padded] = 0.0
    weight, e = work[WEIGHT : WEIGHT + padded], work[RESIDUAL : RESIDUAL + padded]
    for a in range(FREEDOM[kind]):
        mine = work[D0 + a * CHUNK : D0 + a * CHUNK + padded]
        _weighted(mine, weight)
        g[a] += _dot(mine, e)
        for b in range(a + 1):
            H[a, b] += _dot(mine, work[D0 + b * CHUNK : D0 + b * CHUNK + padded])
    return cost, used


@compiled
def residuals(kind: int, th: Array, samples: Array, perspective: bool) -> Array:
    """Return the residuals (N,) of samples (4, N) in sigmas, reduced at grazing rays; NaN where the ray misses."""
    n, frame, work = samples.shape[1], np.empty(6), np.empty(SCRATCH)
    frame_of(kind, th, frame)
    load_rows(samples, work)
    fill_rows(kind, th, frame, n, perspective, work)
    error_row(n, work)
    return work[ERROR : ERROR + n].copy()
