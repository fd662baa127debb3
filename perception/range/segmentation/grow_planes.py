"""Region growing of planes over the grid, from seeds in flat neighbourhoods.

A plane grows as long as its own equation explains the next block, so it stops at a crease however gradually the normals
change there. A plane that grew on a curved surface is rejected, because a quadratic explains its blocks clearly better.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import compiled
from perception.range.segmentation.flat_fit import is_bent, moved_rms, plane_from_coefficients, solve3, squares_left
from perception.range.segmentation.grid import Grid
from perception.range.segmentation.grow_surface import GROW_SIGMAS
from perception.range.segmentation.tangents import STEADY_RMS

SWEEPS = 3  # times that a plane is grown from one seed, each time with the plane of the previous sweep
SAME_BLOCKS = 200  # sweeps end when the number of blocks changes by less than one in this many
SAME_PLANE = 0.1  # sigmas; sweeps end when the plane moves by less, as it then explains the same blocks
MOST_PLANES = 512
LOOSE_NORMAL = 0.5  # stored length of a normal that may seed a plane but is too noisy to be compared with one
TAKEN = np.int32(2**31 - 1)  # mark of a block that belongs to a plane, or is not free
BENT = np.int32(-1)  # owner of a block from which no plane grows, because it is curved


@compiled
def grow_planes(
    grid: Grid, free: Mask, label: Labels, first_label: int, order: Indices, least: int, cos_limit: float,
) -> tuple[Array, Indices, Array]:  # fmt: skip
    """Grow planes over the free blocks; writes their labels, from `first_label` on, into `label` and updates `free`.

    `order`: flat indices of the seeds, the best first. A plane needs `least` blocks, and the normals of its blocks differ
    from its own by an angle whose cosine is at least `cos_limit`.

    Returns parameters (M, 16), numbers of blocks (M,) and mean squared residuals (M,) of the planes.
    """
    h, w = grid.z.shape
    perspective, across = grid.perspective, w + 2
    table, mark, place = _padded(grid, free)
    owner = np.zeros(table.shape[0], np.int32)  # label, or BENT
    queue = np.empty(h * w, np.int32)
    ths, counts, mean2 = np.zeros((MOST_PLANES, 16)), np.zeros(MOST_PLANES, np.int64), np.zeros(MOST_PLANES)
    found, stamp = 0, 0
    m, S, th = np.zeros(3), np.zeros(9), np.zeros(16)
    for seed in order:
        start = place[seed]
        if mark[start] == TAKEN or owner[start] != 0 or found == MOST_PLANES:
            continue
        if not _tangent(table[start], perspective, m):
            continue
        count = 0
        for sweep in range(SWEEPS):
            plane_from_coefficients(m, perspective, th)
            before, a, b, c = count, m[0], m[1], m[2]
            stamp += 2
            count = _grown(table, mark, across, start, stamp, sweep > 0, m, th, perspective, cos_limit, queue, S)
            if count < least or not solve3(S, m):
                count = 0
                break
            is_same = abs(count - before) * SAME_BLOCKS < count
            if sweep > 0 and (is_same or moved_rms(m[0] - a, m[1] - b, m[2] - c, S, count) < SAME_PLANE):
                break
        if count == 0:
            owner[start] = BENT
            continue
        plane_from_coefficients(m, perspective, th)
        flat, bent = _bend(queue, count, table, S)
        owner[queue[:count]] = BENT if bent else first_label + found
        if bent:
            continue
        mark[queue[:count]] = TAKEN
        ths[found], counts[found], mean2[found] = th, count, flat / max(count - 3, 1)
        found += 1
    flat_free, flat_label = free.ravel(), label.ravel()
    for i in range(place.shape[0]):
        if owner[place[i]] > 0:
            flat_label[i], flat_free[i] = owner[place[i]], False
    return ths[:found].copy(), counts[:found].copy(), mean2[:found].copy()


@compiled
def _bend(queue: Labels, count: int, table: Array, S: Array) -> tuple[float, bool]:
    """Return the sum of squared residuals of `count` blocks from their plane, and whether a quadratic is clearly better.

    `S` (9,): sums over the blocks, as `_grown` fills them.
    """
    x0, y0 = S[1] / S[0], S[2] / S[0]
    scale = np.sqrt(max(S[3] / S[0] - x0 * x0 + S[5] / S[0] - y0 * y0, 1e-30))
    flat, quadratic = squares_left(queue, count, table, x0, y0, scale)
    return flat, is_bent(flat, quadratic, count)


@compiled
def _padded(grid: Grid, free: Mask) -> tuple[Array, Labels, Labels]:
    """Copy the blocks into a table with a margin of taken ones, so that growing needs no test for the image border.

    Returns the table (N, 8) of x, y, g (1 / z or z), weight of g, normal (0 if unknown) and z; the marks (N,), `TAKEN`
    where a block is not free; and the row of the table for each block (h w,).
    """
    h, w = grid.z.shape
    across = w + 2
    table, mark = np.zeros(((h + 2) * across, 8)), np.full((h + 2) * across, TAKEN, np.int32)
    place = np.empty(h * w, np.int32)
    for r in range(h):
        for c in range(w):
            i = (r + 1) * across + c + 1
            place[r * w + c] = i
            if not free[r, c]:
                continue
            d = grid.z[r, c]
            weight = (d * d if grid.perspective else 1.0) / grid.sigma[r, c]
            mark[i] = 0
            table[i, 0], table[i, 1], table[i, 2] = grid.x[r, c], grid.y[r, c], 1.0 / d if grid.perspective else d
            table[i, 3], table[i, 7] = weight * weight, d
            if np.isfinite(grid.rms[r, c]):
                # The length of the normal encodes whether `_fits` compares it: noisy normals do not limit growth.
                size = 1.0 if grid.rms[r, c] < STEADY_RMS else LOOSE_NORMAL
                for k in range(3):
                    table[i, 4 + k] = size * grid.normal[r, c, k]
    return table, mark, place


@compiled
def _tangent(block: Array, perspective: bool, m: Array) -> bool:
    """Write the coefficients of a block's tangent plane into `m` (3,); returns False if the plane contains the ray."""
    x, y, nx, ny, nz = block[0], block[1], block[4], block[5], block[6]
    if perspective:
        d = (nx * x + ny * y + nz) * block[7]
        if abs(d) < 1e-9 * (abs(nx) + abs(ny) + abs(nz)):
            return False
        m[0], m[1], m[2] = nx / d, ny / d, nz / d
        return True
    m[0], m[1] = -nx / nz, -ny / nz
    m[2] = block[2] - m[0] * x - m[1] * y
    return True


@compiled
def _add_block(block: Array, S: Array) -> None:
    """Add one row of the table to the weighted sums `S` (9,) that `solve3` reads."""
    x, y, g, weight = block[0], block[1], block[2], block[3]
    wx, wy = weight * x, weight * y
    S[0] += weight
    S[1] += wx
    S[2] += wy
    S[3] += wx * x
    S[4] += wx * y
    S[5] += wy * y
    S[6] += weight * g
    S[7] += wx * g
    S[8] += wy * g


@compiled
def _fits(block: Array, a: float, b: float, c: float, th: Array, limit: float, cos_limit: float) -> bool:
    """Return whether the plane g = a x + b y + c (`th`) explains a block, and the block's normal, if steady, agrees."""
    e = block[2] - a * block[0] - b * block[1] - c
    nx, ny, nz = block[4], block[5], block[6]
    turn = th[0] * nx + th[1] * ny + th[2] * nz
    return bool(e * e * block[3] <= limit and (turn >= cos_limit or nx * nx + ny * ny + nz * nz <= 0.5))


@compiled
def _grown(
    table: Array, mark: Labels, across: int, seed: int, stamp: int, is_fixed: bool, m: Array, th: Array,
    perspective: bool, cos_limit: float, queue: Labels, S: Array,
) -> int:  # fmt: skip
    """Collect the blocks connected to `seed` that the plane explains into `queue`, nearest first; returns their number.

    Unless it is fixed, the plane g = m . (x, y, 1) is refitted as blocks are added, so they are added breadth first, from
    all sides. `S` receives their sums in the form that `solve3` reads. Blocks are marked `stamp`; those that a fixed plane
    does not explain `stamp` - 1, so that each is tested once.
    """
    S[:] = 0.0
    queue[0] = seed
    mark[seed] = stamp
    count, head, refit_at = 1, 0, 8
    a, b, c = m[0], m[1], m[2]
    while head < count:
        i = queue[head]
        head += 1
        _add_block(table[i], S)
        if head == refit_at and not is_fixed:
            refit_at *= 2
            if solve3(S, m):
                plane_from_coefficients(m, perspective, th)
                a, b, c = m[0], m[1], m[2]
        limit = (GROW_SIGMAS + (0.0 if is_fixed else 2.0 / np.sqrt(head))) ** 2
        for side in range(4):
            j = i + (across if side == 0 else -across if side == 1 else 1 if side == 2 else -1)
            if mark[j] >= stamp - 1:
                continue
            if _fits(table[j], a, b, c, th, limit, cos_limit):
                mark[j] = stamp
                queue[count] = j
                count += 1
            elif is_fixed:
                mark[j] = stamp - 1
    return count
