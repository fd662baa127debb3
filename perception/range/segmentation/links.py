"""Connected components of neighbouring blocks without a depth step or a crease, before any surface is known."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Mask
from hal.jit import compiled
from hal.union_find import find, unite
from perception.range.segmentation.tangents import STEADY_RMS


@compiled
def smooth_components(
    blocks: Indices, z: Array, sigma: Array, free: Mask, slope: float, inverse_f: float, perspective: bool,
    normal: Array, rms: Array, cos_limit: float, least: int, most: int,
) -> tuple[Indices, Indices]:  # fmt: skip
    """Return the `most` largest components, of at least `least` blocks, of free blocks that are linked.

    Neighbours are linked where depth and normal change little between them.

    Args:
        blocks: (B,) flat indices of the free blocks, ascending.
        slope: largest slope that is not a jump, metres of depth per metre across, times the side of a block in pixels.
        inverse_f: 1 / focal length (pinhole), or the pixel pitch (orthographic).
        cos_limit: least cosine of the angle between the normals of linked blocks.

    Returns:
        starts (n + 1,) and flat indices (N,): component k, the largest first, owns indices[starts[k] : starts[k + 1]],
        in raster order.
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
    large = blocks[sizes[blocks] >= least]  # the first block of each component, because only roots have a size
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


@compiled
def _is_smooth(
    z: Array, normal: Array, rms: Array, r: int, c: int, i: int, j: int, limit: float, cos_limit: float,
) -> bool:  # fmt: skip
    """Return whether two blocks differ by at most `limit` in depth and little in direction if both normals are reliable."""
    if not abs(z[i, j] - z[r, c]) <= limit:
        return False
    if not (rms[r, c] < STEADY_RMS and rms[i, j] < STEADY_RMS):
        return True
    dot = 0.0
    for k in range(3):
        dot += normal[r, c, k] * normal[i, j, k]
    return not dot < cos_limit
