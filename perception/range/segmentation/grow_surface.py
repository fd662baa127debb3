"""Region growing of a surface of any kind over the grid: the blocks connected to given ones that it explains."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Image, Indices, Mask
from hal.jit import compiled
from perception.range.fitting.surfaces import PLANE, depth_on, normal_on
from perception.range.segmentation.tangents import STEADY_RMS

GROW_SIGMAS = 3.0  # largest residual of a block


@compiled
def grow_surface(
    kind: int, th: Array, x: Array, y: Array, z: Array, sigma: Array, normal: Array, rms: Array, free: Mask,
    seeds: Indices, perspective: bool, cos_limit: float, mark: Image, stamp: int, queue: Indices,
) -> tuple[int, float]:  # fmt: skip
    """Collect the blocks connected to `seeds` that the surface explains into `queue`.

    Returns their number and the sum of their squared residuals, in squared sigmas. `x` to `rms` are the arrays of `Grid`;
    only blocks that are `free` count. `mark` receives `stamp` for each collected block.
    """
    h, w = z.shape
    fx, fy, fz, fs = x.ravel(), y.ravel(), z.ravel(), sigma.ravel()
    ff, fr = free.ravel(), rms.ravel()
    fn = normal.reshape(h * w, 3)
    count, head, total = 0, 0, 0.0
    for k in range(seeds.shape[0]):
        j = seeds[k]
        e2 = _explained(kind, th, fx[j], fy[j], fz[j], fs[j], fn, j, fr[j], perspective, cos_limit)
        if ff[j] and e2 >= 0.0 and mark[j] != stamp:
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    while head < count:
        i = queue[head]
        head += 1
        r, c = i // w, i % w
        for s in range(4):
            rr = r + (1 if s == 0 else -1 if s == 1 else 0)
            cc = c + (1 if s == 2 else -1 if s == 3 else 0)
            if rr < 0 or cc < 0 or rr >= h or cc >= w:
                continue
            j = rr * w + cc
            if mark[j] == stamp or not ff[j]:
                continue
            e2 = _explained(kind, th, fx[j], fy[j], fz[j], fs[j], fn, j, fr[j], perspective, cos_limit)
            if e2 < 0.0:
                continue
            mark[j] = stamp
            queue[count] = j
            count += 1
            total += e2
    return count, total


@compiled
def _explained(
    kind: int, th: Array, x: float, y: float, z: float, sigma: float, normals: Array, j: int, rms: float,
    perspective: bool, cos_limit: float,
) -> float:  # fmt: skip
    """Return the squared residual of block j in squared sigmas, reduced at grazing rays; -1 if the surface fails there."""
    zm = depth_on(kind, th, x, y, perspective)
    if not np.isfinite(zm):
        return -1.0
    e = (z - zm) / sigma
    px, py = (x * zm, y * zm) if perspective else (x, y)
    nx, ny, nz = normal_on(kind, th, px, py, zm)
    facing = nx * x + ny * y + nz if perspective else nz
    reach = np.sqrt(x * x + y * y + 1.0) if perspective else 1.0
    # The sampling error of a block grows with the slope, and dominates at the rim of a curved surface.
    limit = GROW_SIGMAS * min(3.0, max(1.0, 0.5 * reach / max(abs(facing), 1e-3)))
    if abs(e) > limit:
        return -1.0
    if rms < STEADY_RMS and kind != PLANE:
        turn = nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]
        if facing > 0.0:
            turn = -turn
        if turn < cos_limit:
            return -1.0
    e *= GROW_SIGMAS / limit
    return e * e
