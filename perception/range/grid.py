"""The image as a grid of small blocks with a tangent plane each.

Averaging b x b pixels and fitting a plane to the neighbouring blocks is the regularisation that the noise asks for;
blocks that straddle a jump keep only the larger side. Planes are linear in the inverse depth of a pinhole and in the
depth of an orthographic sensor, so one linear fit serves both.
"""

# ruff: noqa: PLR0124 - compiled loops take plain arrays, and long
# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.components import for_each_tile
from perception.range.noise import NoiseModel
from perception.range.sensor import RangeSensorModel
from perception.range.surfaces import LEAN
from perception.range.tangents import tangent_planes

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

JUMP_SLOPE = 2.5  # a surface seen steeper than 68 degrees counts as a jump between blocks
NORMAL_SIGMA_GOAL_RAD = 0.06  # tangent planes noisier than this are fitted over a wider window
WIDEST_RADIUS = 3
LARGE_SIDE_PX = 1024
BLOCK_SAMPLES = 4  # along a block; larger blocks are sampled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Blocks of an image, (h, w) arrays; NaN depth marks an empty block.

    `x`, `y` are coordinates on the plane z = 1 (pinhole) or metres (orthographic), `z` metres, `sigma` the standard
    deviation of `z`, `normal` (h, w, 3) towards the sensor, `rms` what the tangent plane leaves over in sigmas,
    `slow_share` the part of the variance that neighbours share.
    """

    size_px: int
    radius: int
    perspective: bool
    x: Array
    y: Array
    z: Array
    sigma: Array
    normal: Array
    rms: Array
    normal_sigma_rad: float
    slow_share: float


def block_size(shape: tuple[int, int], noise: NoiseModel, sensor: RangeSensorModel, depth_m: float) -> int:
    """Pixels along a block: 1 below 192 rows, 2 below 384, then 3, or 4 where the noise asks for steadier tangent planes.

    Above 1024 rows blocks grow with the image, so that the number of blocks, and with it memory, stays bounded.
    """
    if min(shape) < 192:
        return 1
    if min(shape) < 384:
        return 2
    coarse = -(-min(shape) // LARGE_SIDE_PX)
    if slope_sigma_rad(noise, sensor, depth_m, side_px=15 * coarse) <= NORMAL_SIGMA_GOAL_RAD:
        return 3 * coarse
    return 4 * coarse


def slope_sigma_rad(noise: NoiseModel, sensor: RangeSensorModel, depth_m: float, *, side_px: int) -> float:
    """Standard deviation of the slope of a plane fitted to a square window: sigma / (pitch sqrt(sum u^2)) and more."""
    pitch = sensor.pitch_m(depth_m)
    slow = noise.correlated[0] + noise.correlated[1] * depth_m**2
    step = noise.step[0] + noise.step[1] * depth_m**2
    white = max(float(noise.sigma_m(depth_m)) ** 2 - slow**2, 0.0) ** 0.5 * np.sqrt(12.0) / (pitch * side_px**2)
    # White noise averages out; slow noise and steps do not, they tilt a short window as a whole.
    return float(np.hypot(white, np.hypot(0.7 * slow, 0.3 * step) / (pitch * side_px)))


def build_grid(
    depth_m: Array,
    sensor: RangeSensorModel,
    noise: NoiseModel,
    size_px: int,
    *,
    jump_slope: float = JUMP_SLOPE,
    corner_px: tuple[int, int] = (0, 0),
    tiles: int = 1,
    pool: ThreadPoolExecutor | None = None,
) -> Grid:
    """Blocks of `size_px` pixels of an (H, W) depth image and their tangent planes; the window radius follows noise.

    Neighbours steeper than `jump_slope` (metres of depth per metre across) are apart. `corner_px`: row and column of
    the sensor at which the image begins, for a part of a larger one.
    """
    packed = seen_from(sensor, corner_px)
    law = noise.packed()
    h, w = (-(-n // size_px) for n in depth_m.shape)
    x, y = np.empty((h, w)), np.empty((h, w))
    z, sigma, rms = (np.full((h, w), np.nan) for _ in range(3))
    normal, count = np.full((h, w, 3), np.nan), np.zeros((h, w), np.int32)
    for_each_tile(lambda a, b: _blocks(depth_m, packed, law, size_px, x, y, z, sigma, count, a, b), h, tiles, pool=pool)
    perspective = bool(packed[0] > 0)
    known = z[np.isfinite(z)]
    middle = float(np.median(known[:: max(1, known.size // 1024)])) if known.size else 1.0
    radius, slope_sigma = _radius(noise, sensor, middle, size_px)
    slope = jump_slope / packed[1] * size_px
    for_each_tile(
        lambda a, b: tangent_planes(x, y, z, count, sigma, perspective, radius, slope, normal, rms, a, b),
        h,
        tiles,
        pool=pool,
    )
    return Grid(
        size_px=size_px,
        radius=radius,
        perspective=perspective,
        x=x,
        y=y,
        z=z,
        sigma=sigma,
        normal=normal,
        rms=rms,
        normal_sigma_rad=slope_sigma,
        slow_share=noise.slow_share(middle),
    )


def seen_from(sensor: RangeSensorModel, corner_px: tuple[int, int]) -> Array:
    """(5,) packed sensor of the part of its image that begins at row and column `corner_px`."""
    packed = sensor.packed()
    packed[3] -= corner_px[1]
    packed[4] -= corner_px[0]
    return packed


def _radius(noise: NoiseModel, sensor: RangeSensorModel, depth_m: float, size_px: int) -> tuple[int, float]:
    """Smallest window radius whose slope is known to the goal, and the slope's sigma there."""
    sigma = np.inf
    for radius in range(1, WIDEST_RADIUS + 1):
        sigma = slope_sigma_rad(noise, sensor, depth_m, side_px=(2 * radius + 1) * size_px)
        if sigma <= NORMAL_SIGMA_GOAL_RAD:
            return radius, sigma
    return WIDEST_RADIUS, sigma


@njit(cache=True, **LEAN)
def sigma_at(noise, z):  # type: ignore[no-untyped-def]  # numba types it
    """Standard deviation of one pixel at depth z, metres; `noise` as `NoiseModel.packed`."""
    z2 = z * z
    white = noise[0] + noise[1] * z2
    slow = noise[2] + noise[3] * z2
    step = noise[4] + noise[5] * z2
    return np.sqrt(max(white * white, step * step / 12.0) + slow * slow)


@njit(cache=True, error_model="numpy", **LEAN)
def slow_share_at(noise, z):  # type: ignore[no-untyped-def]  # numba types it
    """Part of the variance at depth z that neighbouring pixels share; `noise` as `NoiseModel.packed`."""
    slow, sigma = noise[2] + noise[3] * z * z, sigma_at(noise, z)
    return slow * slow / max(sigma * sigma, 1e-30)


@njit(cache=True, nogil=True, error_model="numpy")
def _blocks(depth, sen, noise, b, x, y, z, sigma, count, top, bottom):  # type: ignore[no-untyped-def]  # numba types it
    H, W = depth.shape
    w = x.shape[1]
    perspective = sen[0] > 0
    hop = (b + BLOCK_SAMPLES - 1) // BLOCK_SAMPLES
    full = ((b + hop - 1) // hop) ** 2
    values = np.empty(full)
    medians = np.empty(w)
    for r in range(top, bottom):
        y[r] = (r * b + 0.5 * (b - 1) - sen[4]) / sen[2]
        for c in range(w):
            x[r, c] = (c * b + 0.5 * (b - 1) - sen[3]) / sen[1]
        if b == 1:
            medians[:] = depth[r]
        elif b <= BLOCK_SAMPLES and (r + 1) * b <= H:
            _medians_of_four(depth[r * b], depth[(r + 1) * b - 1], b, medians)
            if W % b:
                medians[w - 1] = _median(depth, b, hop, r, w - 1, values)
        else:
            for c in range(w):
                medians[c] = _median(depth, b, hop, r, c, values)
        for c in range(w):
            median = medians[c]
            if not np.isfinite(median):
                continue
            pitch = (median if perspective else 1.0) / sen[1]
            sig = sigma_at(noise, median)
            tol = JUMP_SLOPE * pitch * b * 0.7 + 3.0 * sig
            su, sv, sg, m = 0.0, 0.0, 0.0, 0.0
            per_median = 1.0 / median
            for v in range(r * b, min(r * b + b, H), hop):
                for u in range(c * b, min(c * b + b, W), hop):
                    d = depth[v, u] - median
                    inside = abs(d) <= tol  # refuses NaN
                    q = d * per_median if perspective else d
                    # 1 / (1 + q) by its series: a division less a pixel
                    sg += (q * (q * (q - 1.0) + 1.0) if perspective else -q) if inside else 0.0
                    su += u if inside else 0.0
                    sv += v if inside else 0.0
                    m += 1.0 if inside else 0.0
            x[r, c] = (su / m - sen[3]) / sen[1]
            y[r, c] = (sv / m - sen[4]) / sen[2]
            if 2 * m < full:
                continue
            z[r, c] = median / (1.0 - sg / m) if perspective else median - sg / m
            count[r, c] = int(m)
            z2 = median * median
            slow = noise[2] + noise[3] * z2
            fast = sig * sig - slow * slow
            step = noise[4] + noise[5] * z2
            # Code steps are shared by neighbours, so averaging gains little on them.
            kept = max(fast / m, step * step / 24.0)
            sigma[r, c] = np.sqrt(kept + slow * slow)


@njit(cache=True, error_model="numpy", **LEAN)
def _median(depth, b, hop, r, c, values):  # type: ignore[no-untyped-def]  # numba types it
    """Lower median of a block's samples, a real value and never the empty middle of a jump; NaN if most are missing."""
    n = 0
    for v in range(r * b, min(r * b + b, depth.shape[0]), hop):
        for u in range(c * b, min(c * b + b, depth.shape[1]), hop):
            d = depth[v, u]
            if np.isfinite(d):
                k = n  # insertion sort: at most 16 values
                while k > 0 and values[k - 1] > d:
                    values[k] = values[k - 1]
                    k -= 1
                values[k] = d
                n += 1
    return values[(n - 1) // 2] if n > 0 and 2 * n >= values.shape[0] else np.nan


@njit(cache=True, error_model="numpy", **LEAN)
def _medians_of_four(upper, lower, b, out):  # type: ignore[no-untyped-def]  # numba types it
    """Lower medians of the corners of blocks of b x b pixels, by a sorting network, missing readings last."""
    for c in range(upper.shape[0] // b):
        i, j = c * b, c * b + b - 1
        p, q, s, t = upper[i], upper[j], lower[i], lower[j]
        p, q = p if p == p else np.inf, q if q == q else np.inf
        s, t = s if s == s else np.inf, t if t == t else np.inf
        low_1, high_1, low_2, high_2 = min(p, q), max(p, q), min(s, t), max(s, t)
        second, third = min(max(low_1, low_2), high_1, high_2), max(low_1, low_2, min(high_1, high_2))
        # Of three or four readings the second, of two the first; one alone is too few.
        median = min(low_1, low_2) if third == np.inf else second
        out[c] = median if second < np.inf else np.nan
