"""The image as a grid of small blocks with a tangent plane each.

Averaging b x b pixels and fitting a plane to the neighbouring blocks is the regularisation that the noise asks for;
blocks that straddle a jump keep only the larger side. Planes are linear in the inverse depth of a pinhole and in the
depth of an orthographic sensor, so one linear fit serves both.
"""

# ruff: noqa: PLR0915 - compiled loops take plain arrays, and long
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

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

JUMP_SLOPE = 2.5  # a surface seen steeper than 68 degrees counts as a jump between blocks
JUMP_SIGMAS = 4.0
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
    """Pixels along a block: 1 below 192 rows, 2 below 384, then the least (2 to 4) that gives steady tangent planes.

    Above 1024 rows blocks grow with the image, so that the number of blocks, and with it memory, stays bounded.
    """
    if min(shape) < 192:
        return 1
    if min(shape) < 384:
        return 2
    coarse = -(-min(shape) // LARGE_SIDE_PX)
    for size in (2 * coarse, 3 * coarse):
        if slope_sigma_rad(noise, sensor, depth_m, side_px=5 * size) <= NORMAL_SIGMA_GOAL_RAD:
            return size
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
    tiles: int = 1,
    pool: ThreadPoolExecutor | None = None,
) -> Grid:
    """Blocks of `size_px` pixels of an (H, W) depth image and their tangent planes; the window radius follows noise.

    Neighbours steeper than `jump_slope` (metres of depth per metre across) are apart.
    """
    packed = sensor.packed()
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
    slope = jump_slope / packed[1]
    for_each_tile(
        lambda a, b: _tangents(x, y, z, count, sigma, perspective, radius, slope, size_px, normal, rms, a, b),
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


def _radius(noise: NoiseModel, sensor: RangeSensorModel, depth_m: float, size_px: int) -> tuple[int, float]:
    """Smallest window radius whose slope is known to the goal, and the slope's sigma there."""
    sigma = np.inf
    for radius in range(1, WIDEST_RADIUS + 1):
        sigma = slope_sigma_rad(noise, sensor, depth_m, side_px=(2 * radius + 1) * size_px)
        if sigma <= NORMAL_SIGMA_GOAL_RAD:
            return radius, sigma
    return WIDEST_RADIUS, sigma


@njit(cache=True)
def sigma_at(noise, z):  # type: ignore[no-untyped-def]
    """Standard deviation of one pixel at depth z, metres; `noise` as `NoiseModel.packed`."""
    z2 = z * z
    white = noise[0] + noise[1] * z2
    slow = noise[2] + noise[3] * z2
    step = noise[4] + noise[5] * z2
    return np.sqrt(max(white * white, step * step / 12.0) + slow * slow)


@njit(cache=True, nogil=True)
def _blocks(depth, sen, noise, b, x, y, z, sigma, count, top, bottom):  # type: ignore[no-untyped-def]
    H, W = depth.shape
    w = x.shape[1]
    perspective = sen[0] > 0
    hop = (b + BLOCK_SAMPLES - 1) // BLOCK_SAMPLES
    full = ((b + hop - 1) // hop) ** 2
    values = np.empty(full)
    for r in range(top, bottom):
        for c in range(w):
            n = 0
            for v in range(r * b, min(r * b + b, H), hop):
                for u in range(c * b, min(c * b + b, W), hop):
                    d = depth[v, u]
                    if np.isfinite(d):
                        k = n  # insertion sort: at most 16 values
                        while k > 0 and values[k - 1] > d:
                            values[k] = values[k - 1]
                            k -= 1
                        values[k] = d
                        n += 1
            if 2 * n < full or n == 0:
                x[r, c] = (c * b + 0.5 * (b - 1) - sen[3]) / sen[1]
                y[r, c] = (r * b + 0.5 * (b - 1) - sen[4]) / sen[2]
                continue
            median = values[(n - 1) // 2]  # a real value, never the empty middle of a jump
            pitch = (median if perspective else 1.0) / sen[1]
            sig = sigma_at(noise, median)
            tol = JUMP_SLOPE * pitch * b * 0.7 + 3.0 * sig
            su, sv, sg, m = 0.0, 0.0, 0.0, 0
            for v in range(r * b, min(r * b + b, H), hop):
                for u in range(c * b, min(c * b + b, W), hop):
                    d = depth[v, u]
                    if abs(d - median) <= tol:
                        su += u
                        sv += v
                        sg += 1.0 / d if perspective else d
                        m += 1
            x[r, c] = (su / m - sen[3]) / sen[1]
            y[r, c] = (sv / m - sen[4]) / sen[2]
            if 2 * m < full:
                continue
            z[r, c] = m / sg if perspective else sg / m
            count[r, c] = m
            z2 = median * median
            slow = noise[2] + noise[3] * z2
            fast = sig * sig - slow * slow
            step = noise[4] + noise[5] * z2
            # Code steps are shared by neighbours, so averaging gains little on them.
            kept = max(fast / m, step * step / 24.0)
            sigma[r, c] = np.sqrt(kept + slow * slow)


@njit(cache=True, nogil=True)
def _tangents(  # type: ignore[no-untyped-def]
    x, y, z, count, sigma, perspective, radius, slope_per_pixel, b, normal, rms, top, bottom
):
    h, w = z.shape
    least = max(5, ((2 * radius + 1) ** 2) * 2 // 5)
    for r in range(top, bottom):
        for c in range(w):
            z0 = z[r, c]
            if not np.isfinite(z0):
                continue
            base, slope = JUMP_SIGMAS * sigma[r, c], (z0 if perspective else 1.0) * slope_per_pixel * b
            x0, y0 = x[r, c], y[r, c]
            g0 = 1.0 / z0 if perspective else z0
            n = 0
            s, sx, sy, sg, sxx, sxy, syy, sxg, syg, sgg = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(max(0, r - radius), min(h, r + radius + 1)):
                for j in range(max(0, c - radius), min(w, c + radius + 1)):
                    zj = z[i, j]
                    reach = max(abs(i - r), abs(j - c))
                    if not abs(zj - z0) <= base + slope * reach:  # also refuses NaN
                        continue
                    k = float(count[i, j])
                    dx, dy = x[i, j] - x0, y[i, j] - y0
                    g = (1.0 / zj if perspective else zj) - g0
                    n += 1
                    s += k
                    sx += k * dx
                    sy += k * dy
                    sg += k * g
                    sxx += k * dx * dx
                    sxy += k * dx * dy
                    syy += k * dy * dy
                    sxg += k * dx * g
                    syg += k * dy * g
                    sgg += k * g * g
            if n < least:
                continue
            sxx -= sx * sx / s
            sxy -= sx * sy / s
            syy -= sy * sy / s
            sxg -= sx * sg / s
            syg -= sy * sg / s
            sgg -= sg * sg / s
            det = sxx * syy - sxy * sxy
            if det <= 1e-4 * sxx * syy or det <= 0.0:
                continue
            p = (syy * sxg - sxy * syg) / det
            q = (sxx * syg - sxy * sxg) / det
            left = max(sgg - p * sxg - q * syg, 0.0) / s * n / max(n - 3, 1)
            scale = z0 * z0 if perspective else 1.0
            rms[r, c] = np.sqrt(left) * scale / sigma[r, c]
            if perspective:
                # w = p x + q y + c is the plane (p, q, c) . X = 1
                nx, ny, nz = p, q, g0 + (sg - p * sx - q * sy) / s - p * x0 - q * y0
                facing = nx * x0 + ny * y0 + nz
            else:
                nx, ny, nz = -p, -q, 1.0
                facing = 1.0
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if facing > 0:
                length = -length
            normal[r, c, 0] = nx / length
            normal[r, c, 1] = ny / length
            normal[r, c, 2] = nz / length
