"""Which neighbouring blocks belong together before any surface is known: depth without a step, normals without a crease.

`components` labels whole images, in tiles; the blocks that are still free are few, and one pass over them tells theirs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.range.components import find, unite
from perception.range.fitting.surfaces import LEAN
from perception.range.segmentation.tangents import STEADY_RMS


@njit(cache=True)
def smooth_links(z, sigma, free, slope, inverse_f, perspective, normal, rms, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Which free blocks belong with their right and lower neighbour: a small depth step and a small turn between."""
    h, w = z.shape
    right, down = np.zeros((h, w), np.bool_), np.zeros((h, w), np.bool_)
    for r in range(h):
        for c in range(w):
            if free[r, c]:
                limit = slope * (z[r, c] if perspective else 1.0) * inverse_f + 4.0 * sigma[r, c]
                for s in range(2):
                    i, j = r + s, c + 1 - s
                    if i < h and j < w and free[i, j] and _is_smooth(z, normal, rms, r, c, i, j, limit, cos_limit):
                        if s == 0:
                            right[r, c] = True
                        else:
                            down[r, c] = True
    return right, down


@njit(cache=True, error_model="numpy", nogil=True)
def smooth_components(z, sigma, free, slope, inverse_f, perspective, normal, rms, cos_limit, least, most):  # type: ignore[no-untyped-def]  # numba types it
    """Components of at least `least` free blocks over `smooth_links`, the `most` largest, those first.

    Returns starts (n + 1,) and flat block indices (N,) in raster order: component k owns indices[starts[k] : starts[k + 1]].
    """
    h, w = z.shape
    parent, sizes = np.arange(h * w), np.zeros(h * w, np.int64)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            limit = slope * (z[r, c] if perspective else 1.0) * inverse_f + 4.0 * sigma[r, c]
            for s in range(2):
                i, j = r + s, c + 1 - s
                if i < h and j < w and free[i, j] and _is_smooth(z, normal, rms, r, c, i, j, limit, cos_limit):
                    unite(parent, r * w + c, i * w + j)
    blocks = np.flatnonzero(free)
    roots = np.empty_like(blocks)
    for n in range(blocks.shape[0]):
        roots[n] = find(parent, blocks[n])
        sizes[roots[n]] += 1
    large = np.flatnonzero(sizes >= least)
    large = large[np.argsort(-sizes[large], kind="mergesort")][:most]
    starts = np.zeros(large.shape[0] + 1, np.int64)
    place = np.full(h * w, -1)
    for k in range(large.shape[0]):
        starts[k + 1] = starts[k] + sizes[large[k]]
        place[large[k]] = starts[k]
    indices = np.empty(starts[-1], np.int64)
    for n in range(blocks.shape[0]):
        at = place[roots[n]]
        if at >= 0:
            indices[at] = blocks[n]
            place[roots[n]] += 1
    return starts, indices


@njit(cache=True, error_model="numpy", **LEAN)
def _is_smooth(z, normal, rms, r, c, i, j, limit, cos_limit):  # type: ignore[no-untyped-def]  # numba types it
    """Whether two blocks differ by at most `limit` in depth, and their normals, where both are steady, by a small turn."""
    if not abs(z[i, j] - z[r, c]) <= limit:
        return False
    if not (rms[r, c] < STEADY_RMS and rms[i, j] < STEADY_RMS):
        return True
    dot = 0.0
    for k in range(3):
        dot += normal[r, c, k] * normal[i, j, k]
    return not dot < cos_limit
