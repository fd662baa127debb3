"""Connected components of neighbouring blocks without a depth step or a crease, before any surface is known."""

from __future__ import annotations

import numpy as np

from hal.arrays import Indices, Mask
from hal.jit import compiled
from hal.union_find import find, unite
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.tangents import STEADY_RMS


@compiled
def smooth_components(
    blocks: Indices, grid: Grid, free: Mask, slope_per_block: float, cos_limit: float, least: int, most: int,
) -> tuple[Indices, Indices]:  # fmt: skip
    """Return the `most` largest components, of at least `least` blocks, of free blocks that are linked.

    Neighbours are linked where depth and normal change little between them.

    Args:
        blocks: (B,) flat indices of the free blocks, ascending.
        slope_per_block: largest step that is not a jump, metres per block (and per metre of depth, if perspective).
        cos_limit: least cosine of the angle between the normals of linked blocks.

    Returns:
        starts (n + 1,) and flat indices (N,): component k, the largest first, owns indices[starts[k] : starts[k + 1]],
        in raster order.
    """
    h, w = grid.z.shape
    parent, sizes = np.empty(h * w, np.int64), np.empty(h * w, np.int64)
    for i in blocks:
        parent[i], sizes[i] = i, 0
    for at in blocks:
        r, c = at // w, at % w
        limit = slope_per_block * (grid.z[r, c] if grid.perspective else 1.0) + 4.0 * grid.sigma[r, c]
        for s in range(2):
            i, j = r + s, c + 1 - s
            if i < h and j < w and free[i, j] and _is_smooth(grid, r, c, i, j, limit, cos_limit):
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
def _is_smooth(grid: Grid, r: int, c: int, i: int, j: int, limit: float, cos_limit: float) -> bool:
    """Return whether two blocks differ by at most `limit` in depth and little in direction if both normals are reliable."""
    if not abs(grid.z[i, j] - grid.z[r, c]) <= limit:
        return False
    if not (grid.rms[r, c] < STEADY_RMS and grid.rms[i, j] < STEADY_RMS):
        return True
    dot = 0.0
    for k in range(3):
        dot += grid.normal[r, c, k] * grid.normal[i, j, k]
    return not dot < cos_limit
