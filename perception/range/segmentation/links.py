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
def smooth_components(blocks, z, sigma, free, slope, inverse_f, perspective, normal, rms, cos_limit, least, most):  # type: ignore[no-untyped-def]  # numba types it
    """Components of at least `least` free blocks over `smooth_links`, the `most` largest, those first.

    `blocks` (B,): the free ones, flat, ascending. Returns starts (n + 1,) and flat indices (N,) in raster order: component
    k owns indices[starts[k] : starts[k + 1]].
    """
    h, w = z.shape
    parent, sizes = np.empty(h * w, np.int64), np.empty(h * w, np.int64)
    for i in blocks:
        parent[i], sizes[i] = i, 0
    for at in blocks:
        r, c = at // w, at % w
        limit = slope * (z[r, c] if perspective else 1.0) * inverse_f + 4.0 * sigma[r, c]
        for s in range(2):
            i, j = r + s, c + 1 - s
            if i < h and j < w and free[i, j] and _is_smooth(z, normal, rms, r, c, i, j, limit, cos_limit):
                unite(parent, at, i * w + j)
    for i in blocks:
        sizes[find(parent, i)] += 1
    large = blocks[sizes[blocks] >= least]  # their first blocks: no other has a size
    large = large[np.argsort(-sizes[large], kind="mergesort")][:most]
    starts = np.zeros(large.shape[0] + 1, np.int64)
    starts[1:] = np.cumsum(sizes[large])
    place, indices = sizes, np.empty(starts[-1], np.int64)
    place[blocks] = -1
    place[large] = starts[:-1]
    for i in blocks:
        root = find(parent, i)
        if place[root] >= 0:
            indices[place[root]] = i
            place[root] += 1
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
