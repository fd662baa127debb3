"""Region growing of a surface of any kind over the grid: the blocks connected to given ones that it explains."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Image, Indices, Mask
from hal.jit import compiled
from perception.range.fitting.surfaces import PLANE, depth_on, normal_on
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.tangents import STEADY_RMS

GROW_SIGMAS = 3.0  # largest residual of a block


@compiled
def grow_surface(
    kind: int, th: Array, grid: Grid, free: Mask, seeds: Indices, cos_limit: float, mark: Image, stamp: int,
    queue: Indices,
) -> tuple[int, float]:  # fmt: skip
    """Collect the blocks connected to `seeds` that the surface explains into `queue`.

    Returns their number and the sum of their squared residuals, in squared sigmas. Only blocks that are `free` count.
    `mark` receives `stamp` for each collected block.
    """
    h, w = grid.z.shape
    flat_free = free.ravel()
    count, head, total = 0, 0, 0.0
    for j in seeds:
        e2 = _explained(kind, th, grid, j, cos_limit)
        if flat_free[j] and e2 >= 0.0 and mark[j] != stamp:
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    while head < count:
        r, c = queue[head] // w, queue[head] % w
        head += 1
        for rr, cc in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
            if rr < 0 or cc < 0 or rr >= h or cc >= w:
                continue
            j = rr * w + cc
            if mark[j] == stamp or not flat_free[j]:
                continue
            e2 = _explained(kind, th, grid, j, cos_limit)
            if e2 < 0.0:
                continue
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    return count, total


@compiled
def _explained(kind: int, th: Array, grid: Grid, j: int, cos_limit: float) -> float:
    """Return the squared residual of block j in squared sigmas, reduced at grazing rays; -1 if the surface fails there."""
    r, c = j // grid.z.shape[1], j % grid.z.shape[1]
    x, y, perspective = grid.x[r, c], grid.y[r, c], grid.perspective
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return -1.0
    e = (grid.z[r, c] - zm) / grid.sigma[r, c]
    px, py = (x * zm, y * zm) if perspective else (x, y)
    nx, ny, nz = normal_on(kind, th, px, py, zm)
    facing = nx * x + ny * y + nz if perspective else nz
    reach = np.sqrt(x * x + y * y + 1.0) if perspective else 1.0
    # The sampling error of a block grows with the slope, and dominates at the rim of a curved surface.
    limit = GROW_SIGMAS * min(3.0, max(1.0, 0.5 * reach / max(abs(facing), 1e-3)))
    if abs(e) > limit:
        return -1.0
    if grid.rms[r, c] < STEADY_RMS and kind != PLANE:
        turn = nx * grid.normal[r, c, 0] + ny * grid.normal[r, c, 1] + nz * grid.normal[r, c, 2]
        if (turn if facing <= 0.0 else -turn) < cos_limit:
            return -1.0
    e *= GROW_SIGMAS / limit
    return float(e * e)
