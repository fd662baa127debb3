"""Search for the strongest edge along a normal: the compiled inner loop of `register`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled
from perception.vision.bilinear import value_at

STEP_PX = 0.5  # distance between samples along a normal


@compiled
def strongest_edges(
    smooth: NDArray[np.float32], points_px: Array, normals_px: Array, window_px: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Find where the slope along every normal is steepest, with a Gaussian preference for small offsets.

    Args:
        smooth: (H, W) gray.
        points_px, normals_px: (N, 2) points (u, v) and unit directions.
        window_px: half length of the search, and standard deviation of the preference.

    Returns:
        (N,) signed offset in px, refined by a parabola through three slopes; (N,) the slope there, gray levels per px;
        and (N,) whether the whole normal lies inside the image (offset and slope are 0 where it does not).
    """
    height, width = smooth.shape
    half = int(window_px / STEP_PX)
    preference = np.exp(-0.5 * (np.arange(-half, half + 1) * STEP_PX / window_px) ** 2)
    offsets, peaks = np.zeros(len(points_px)), np.zeros(len(points_px))
    visible = np.zeros(len(points_px), np.bool_)
    values, slopes = np.empty(2 * half + 3), np.empty(2 * half + 1)
    reach = (half + 1) * STEP_PX
    for i in range(len(points_px)):
        u, v = points_px[i]
        along_u, along_v = normals_px[i]
        over_u, over_v = abs(along_u) * reach, abs(along_v) * reach
        # A point that is not finite fails this test, too.
        visible[i] = u - over_u >= 1 and v - over_v >= 1 and u + over_u < width - 2 and v + over_v < height - 2
        if not visible[i]:
            continue
        for k in range(2 * half + 3):
            t = k * STEP_PX - reach
            values[k] = value_at(smooth, u + along_u * t, v + along_v * t)
        best, most = 1, -1.0
        for k in range(2 * half + 1):
            slopes[k] = abs(values[k + 2] - values[k]) / (2 * STEP_PX)
            if slopes[k] * preference[k] > most:
                best, most = k, slopes[k] * preference[k]
        best = min(max(best, 1), 2 * half - 1)
        before, peaks[i], after = slopes[best - 1], slopes[best], slopes[best + 1]
        bend = before - 2 * peaks[i] + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
        offsets[i] = (best - half + min(max(shift, -1.0), 1.0)) * STEP_PX
    return offsets, peaks, visible
