"""Which neighbouring blocks belong together before any surface is known: depth without a step, normals without a crease."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.segmentation.tangents import STEADY_RMS


@njit(cache=True)
def smooth_links(z, sigma, free, slope, inverse_f, perspective, normal, rms, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Which free blocks belong with their right and lower neighbour: a small depth step and a small turn between."""
    h, w = z.shape
    right, down = np.zeros((h, w), np.bool_), np.zeros((h, w), np.bool_)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            limit = slope * (z[r, c] if perspective else 1.0) * inverse_f + 4.0 * sigma[r, c]
            for s in range(2):
                i, j = r + s, c + 1 - s
                if i >= h or j >= w or not free[i, j] or not abs(z[i, j] - z[r, c]) <= limit:
                    continue
                if rms[r, c] < STEADY_RMS and rms[i, j] < STEADY_RMS:
                    dot = 0.0
                    for k in range(3):
                        dot += normal[r, c, k] * normal[i, j, k]
                    if dot < cos_limit:
                        continue
                if s == 0:
                    right[r, c] = True
                else:
                    down[r, c] = True
    return right, down
