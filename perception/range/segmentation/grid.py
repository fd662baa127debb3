"""The image as a grid of small blocks, each with a tangent plane.

Averaging b x b pixels and fitting a plane to the neighbouring blocks suppresses the noise. A block across a depth jump
uses only the pixels on the side of its median. Planes are linear in the inverse depth of a pinhole sensor and in the
depth of an orthographic sensor, so one linear fit serves both.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from hal.arrays import Array
from hal.jit import compiled
from perception.range.noise import NoiseModel, valid_sample
from perception.range.segmentation.blocks import JUMP_SLOPE, mean_blocks
from perception.range.segmentation.tangents import tangent_planes
from perception.range.sensor import RangeSensorModel
from perception.range.tiles import for_each_tile

NORMAL_SIGMA_GOAL_RAD = 0.06  # tangent planes noisier than this are fitted over a wider window
WIDEST_RADIUS = 3  # blocks
LARGE_SIDE_PX = 1024  # shorter side of an image from which the size of blocks grows with the image
MIDDLE_SAMPLES = 1024  # depths from which the median is estimated


class Grid(NamedTuple):
    """Blocks of an image and their tangent planes, as (h, w) arrays; NaN depth marks an empty block.

    Attributes:
        size_px: side of a block.
        radius: radius in blocks of the window to which each tangent plane is fitted.
        perspective: whether the sensor is a pinhole.
        x, y: mean ray coordinates, on the plane z = 1 (pinhole) or in metres (orthographic).
        z, sigma: mean depth and its standard deviation, metres.
        normal: (h, w, 3) unit normal of the tangent plane, towards the sensor.
        rms: root mean square residual of the tangent plane, in sigmas.
        normal_sigma_rad: expected standard deviation of the normals.
        slow_share: share of a pixel's variance that neighbouring pixels have in common, 0 to 1.
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
    """Return the side of a block in pixels: 1 below 192 rows, 2 below 384, then 3, or 4 if the noise is large.

    Rows are those of the shorter side. Above 1024 blocks grow with the image, so that their number, and with it memory,
    stays bounded.
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
    """Return the standard deviation of the slope of a plane fitted to a square window of the given side.

    White noise contributes sigma / (pitch sqrt(sum u^2)), with u the pixel offsets from the centre; slow noise and
    quantisation steps are added.
    """
    pitch = sensor.pitch_m(depth_m)
    slow = noise.correlated[0] + noise.correlated[1] * depth_m**2
    step = noise.step[0] + noise.step[1] * depth_m**2
    white = max(noise.sigma_of(depth_m) ** 2 - slow**2, 0.0) ** 0.5 * np.sqrt(12.0) / (pitch * side_px**2)
    # White noise averages out; slow noise and steps do not, because they tilt a short window as a whole.
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
    """Divide an (H, W) depth image into blocks of `size_px` pixels and fit a tangent plane to each.

    Args:
        noise: sets the standard deviations, and the radius of the windows of the tangent planes.
        jump_slope: largest slope between neighbouring blocks of one surface, metres of depth per metre across.
        corner_px: row and column in the sensor's image at which `depth_m` begins, if it is only a part of that image.
        tiles, pool: number of parts computed in parallel, and the threads that compute them.
    """
    packed = seen_from(sensor, corner_px)
    law = noise.packed()
    h, w = (-(-n // size_px) for n in depth_m.shape)
    x, y = np.empty((h, w)), np.empty((h, w))
    z, sigma, count = np.empty((h, w)), np.empty((h, w)), np.empty((h, w), np.int32)
    for_each_tile(
        lambda a, b: mean_blocks(depth_m, packed, law, size_px, x, y, z, sigma, count, a, b), h, tiles, pool=pool
    )
    perspective = bool(packed[0] > 0)
    known = valid_sample(z, MIDDLE_SAMPLES)
    middle = float(np.median(known)) if known.size else 1.0
    radius, slope_sigma = _radius(noise, sensor, middle, size_px)
    slope = jump_slope / packed[1] * size_px
    normal, rms = np.full((h, w, 3), np.nan), np.full((h, w), np.nan)
    for_each_tile(
        lambda a, b: tangent_planes(x, y, z, count, sigma, perspective, radius, slope, normal, rms, a, b),
        h,
        tiles,
        pool=pool,
    )
    share = noise.slow_share(middle)
    return Grid(size_px, radius, perspective, x, y, z, sigma, normal, rms, slope_sigma, share)


def seen_from(sensor: RangeSensorModel, corner_px: tuple[int, int]) -> Array:
    """Return the packed sensor (5,) for the part of its image that begins at row and column `corner_px`."""
    packed = sensor.packed()
    packed[3] -= corner_px[1]
    packed[4] -= corner_px[0]
    return packed


def _radius(noise: NoiseModel, sensor: RangeSensorModel, depth_m: float, size_px: int) -> tuple[int, float]:
    """Return the smallest window radius at which the slope is accurate enough, and the slope's standard deviation."""
    sigma = np.inf
    for radius in range(1, WIDEST_RADIUS + 1):
        sigma = slope_sigma_rad(noise, sensor, depth_m, side_px=(2 * radius + 1) * size_px)
        if sigma <= NORMAL_SIGMA_GOAL_RAD:
            return radius, sigma
    return WIDEST_RADIUS, sigma


@compiled
def sigma_at(noise: Array, z: float) -> float:
    """Return the standard deviation of one pixel at depth z, metres; `noise` as `NoiseModel.packed`."""
    z2 = z * z
    white = noise[0] + noise[1] * z2
    slow = noise[2] + noise[3] * z2
    step = noise[4] + noise[5] * z2
    return float(np.sqrt(max(white * white, step * step / 12.0) + slow * slow))


@compiled
def slow_share_at(noise: Array, z: float) -> float:
    """Return the share of the variance at depth z that neighbouring pixels have in common.

    `noise` as `NoiseModel.packed`.
    """
    slow, sigma = noise[2] + noise[3] * z * z, sigma_at(noise, z)
    return float(slow * slow / max(sigma * sigma, 1e-30))
