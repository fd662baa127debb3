"""Filters that keep holes and edges: median for gross errors, gaussian for measurement errors (paper, Section III)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range.noise import NoiseModel
from perception.range.sensor import RangeSensorModel

GROSS_SIGMAS = 6.0
EDGE_SIGMAS = 4.0
EDGE_SLOPE = 2.5  # metres of depth per metre across; steeper neighbours lie on another surface
LEAST_SUPPORT = 3  # neighbours of 24 that must agree with a pixel before it counts as measured


def median(depth_m: Array) -> Array:
    """5x5 median of an (H, W) image; holes stay holes and lend their place to the image's own median around them.

    OpenCV's median knows no holes: they are filled with the median of the nearest valid pixels first.
    """
    finite = np.isfinite(depth_m)
    filled = _filled(depth_m, finite)
    out = cv2.medianBlur(filled.astype(np.float32), 5).astype(np.float64)
    out[~finite] = np.nan
    return out


def remove_gross_errors(depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel) -> Array:
    """The image with gross errors replaced by the local median, and everything else untouched.

    A pixel is a gross error when fewer than 3 of its 24 neighbours lie within noise and slope of it. So thin things,
    corners and edges survive, which a plain median rounds off.
    """
    packed = sensor.packed()
    sigma = np.nan_to_num(noise.sigma_m(np.nan_to_num(depth_m, nan=1.0)))
    lonely = _lonely(depth_m, sigma, bool(packed[0] > 0), EDGE_SLOPE / packed[1])
    if not lonely.any():
        return depth_m.copy()
    return np.where(lonely, median(depth_m), depth_m)


def gaussian(depth_m: Array, sensor: RangeSensorModel, noise: NoiseModel, *, sigma_px: float) -> Array:
    """Gaussian mean over the neighbours that lie on the same surface; holes and edges are kept.

    Neighbours farther in depth than noise and a slope of 68 degrees allow take no part (normalised convolution).
    """
    packed = sensor.packed()
    radius = max(1, int(np.ceil(2.5 * sigma_px)))
    t = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (t / max(sigma_px, 1e-6)) ** 2)
    tolerance = EDGE_SIGMAS * np.nan_to_num(noise.sigma_m(np.nan_to_num(depth_m, nan=1.0)))
    return np.asarray(_edge_mean(depth_m, tolerance, kernel, bool(packed[0] > 0), EDGE_SLOPE / packed[1]))


def _filled(depth_m: Array, finite: NDArray[np.bool_]) -> Array:
    if finite.all():
        return depth_m
    if not finite.any():
        return np.zeros_like(depth_m)
    # Grow valid values into the holes by normalised means of ever larger windows.
    filled = np.where(finite, depth_m, 0.0)
    weight = finite.astype(np.float64)
    out, known = filled.copy(), finite.copy()
    size = 3
    while not known.all():
        mean = cv2.blur(filled, (size, size)) / np.maximum(cv2.blur(weight, (size, size)), 1e-12)
        reach = cv2.blur(weight, (size, size)) > 1e-9
        new = reach & ~known
        out[new] = mean[new]
        known |= reach
        size = min(2 * size + 1, 2 * max(depth_m.shape) + 1)
    return out


@njit(cache=True, nogil=True)
def _lonely(depth, sigma, perspective, slope):  # type: ignore[no-untyped-def]  # numba types it
    H, W = depth.shape
    out = np.zeros((H, W), np.bool_)
    for v in range(H):
        for u in range(W):
            z = depth[v, u]
            if not np.isfinite(z):
                continue
            near = 0
            step = slope * z if perspective else slope
            for i in range(max(0, v - 2), min(H, v + 3)):
                for j in range(max(0, u - 2), min(W, u + 3)):
                    reach = max(abs(i - v), abs(j - u))
                    if reach and abs(depth[i, j] - z) <= GROSS_SIGMAS * sigma[v, u] + step * reach:
                        near += 1
            out[v, u] = near < LEAST_SUPPORT
    return out


@njit(cache=True, nogil=True)
def _edge_mean(depth, tolerance, kernel, perspective, slope):  # type: ignore[no-untyped-def]  # numba types it
    H, W = depth.shape
    radius = kernel.shape[0] // 2
    out = np.full((H, W), np.nan)
    for v in range(H):
        for u in range(W):
            z = depth[v, u]
            if not np.isfinite(z):
                continue
            step = slope * z if perspective else slope
            total, weight = 0.0, 0.0
            for i in range(max(0, v - radius), min(H, v + radius + 1)):
                for j in range(max(0, u - radius), min(W, u + radius + 1)):
                    d = depth[i, j]
                    reach = max(abs(i - v), abs(j - u))
                    if abs(d - z) <= tolerance[v, u] + step * reach:
                        w = kernel[i - v + radius] * kernel[j - u + radius]
                        # Opposite neighbours pair up only when both count; alone they would tilt the mean.
                        p, q = 2 * v - i, 2 * u - j
                        if 0 <= p < H and 0 <= q < W and abs(depth[p, q] - z) <= tolerance[v, u] + step * reach:
                            total += w * d
                            weight += w
            out[v, u] = total / weight
    return out
