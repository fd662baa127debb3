"""Estimation of the pixel noise of a gray image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.jit import compiled

LEAST_NOISE = 0.3  # gray levels; the effect of rounding
ENOUGH_PX = 50_000  # number of pixels that is enough for the estimate, which then has an error of less than one percent


def noise_sigma(gray: Image) -> float:
    """Return the standard deviation of the pixel noise: J. Immerkaer, CVIU 64(2), 1996, with the median, not the mean.

    In a large picture only as many rows are used as are enough.
    """
    if min(gray.shape) < 3:
        return LEAST_NOISE
    counts = _response_counts(gray, max(1, gray.size // ENOUGH_PX))
    median = int(np.searchsorted(np.cumsum(counts), (counts.sum() + 1) // 2))
    return float(max(median / 0.6745 / 6.0, LEAST_NOISE))


@compiled
def _response_counts(gray: Image, step: int) -> NDArray[np.int64]:
    """Return the histogram of the absolute response to [1 -2 1; -2 4 -2; 1 -2 1] in every `step`-th row."""
    height, width = gray.shape
    counts = np.zeros(8 * 255 + 1, np.int64)
    for v in range(1, height - 1, step):
        for u in range(1, width - 1):
            before = np.int32(gray[v - 1, u - 1]) - 2 * np.int32(gray[v, u - 1]) + np.int32(gray[v + 1, u - 1])
            here = np.int32(gray[v - 1, u]) - 2 * np.int32(gray[v, u]) + np.int32(gray[v + 1, u])
            after = np.int32(gray[v - 1, u + 1]) - 2 * np.int32(gray[v, u + 1]) + np.int32(gray[v + 1, u + 1])
            counts[abs(before - 2 * here + after)] += 1
    return counts
