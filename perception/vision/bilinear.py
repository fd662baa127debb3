"""Compiled bilinear sampling: one pass, without the intermediate arrays that numpy and OpenCV would need."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled, inlined


@inlined
def value_at(image: NDArray[Any], u: float, v: float) -> float:
    """Return the bilinear value of an (H, W) image at (u, v); beyond the border the image repeats its edge."""
    height, width = image.shape
    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    x, y = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    right, below = min(x + 1, width - 1), min(y + 1, height - 1)
    a, b = u - x, v - y
    above = image[y, x] * (1.0 - a) + image[y, right] * a
    return float(above * (1.0 - b) + (image[below, x] * (1.0 - a) + image[below, right] * a) * b)


@compiled
def polar_values(
    image: Image, centre_px: tuple[float, float], radii_px: Array, directions: Array
) -> NDArray[np.float32]:
    """Return values (radii, directions) about a centre.

    `directions` is (2, N): the change of u and of v per pixel of radius.
    """
    out = np.empty((len(radii_px), directions.shape[1]), np.float32)
    for i in range(len(radii_px)):
        for j in range(directions.shape[1]):
            out[i, j] = value_at(
                image, centre_px[0] + radii_px[i] * directions[0, j], centre_px[1] + radii_px[i] * directions[1, j]
            )
    return out


@compiled
def step_counts(gray: Image, every: int) -> NDArray[np.int64]:
    """Return the histogram (1021,) of the absolute second difference along every `every`-th row."""
    counts = np.zeros(4 * 255 + 1, np.int64)
    for v in range(0, gray.shape[0], every):
        for u in range(1, gray.shape[1] - 1):
            counts[abs(np.int32(gray[v, u - 1]) - 2 * np.int32(gray[v, u]) + np.int32(gray[v, u + 1]))] += 1
    return counts
