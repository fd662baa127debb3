"""Connected components of a sparse mask by runs: only boxes and middles, which is ten times faster than labelling.

A run is a row of neighbouring pixels; runs (3, N) are their first and last columns and their rows, in raster order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined
from hal.union_find import find, unite

Runs = NDArray[np.int32]


def components(mask: NDArray[np.uint8], *, diagonal: bool) -> Array:
    """Return left, top, width, height and middle (u, v) of every connected part (N, 6), in raster order.

    Args:
        mask: (H, W) uint8, nonzero inside.
        diagonal: whether pixels that touch at a corner are connected.
    """
    return connected(runs_of(np.ascontiguousarray(mask)), diagonal=diagonal)


def connected(runs: Runs, *, diagonal: bool) -> Array:
    """Return the `components` of the pixels in runs."""
    return np.asarray(_connected(runs, 1 if diagonal else 0))


@compiled
def runs_of(mask: NDArray[np.uint8]) -> Runs:
    """Return the runs of nonzero pixels of a mask (H, W)."""
    height, width = mask.shape
    runs = np.empty((3, height * (width + 1) // 2 + 1), np.int32)
    count = 0
    for v in range(height):
        u = 0
        while u < width:
            if mask[v, u] == 0:
                u += 1
                continue
            runs[0, count], runs[2, count] = u, v
            while u < width and mask[v, u] != 0:
                u += 1
            runs[1, count] = u - 1
            count += 1
    return runs[:, :count].copy()


@compiled
def bridged(runs: Runs, gap_px: int, least_px: int) -> Runs:
    """Return the runs with the gaps of up to `gap_px` between them filled, without those shorter than `least_px`."""
    out = np.empty_like(runs)
    count, k = 0, 0
    while k < runs.shape[1]:
        first, last, row = runs[0, k], runs[1, k], runs[2, k]
        k += 1
        while k < runs.shape[1] and runs[2, k] == row and runs[0, k] - last <= gap_px + 1:
            last = runs[1, k]
            k += 1
        if last - first + 1 >= least_px:
            out[0, count], out[1, count], out[2, count] = first, last, row
            count += 1
    return out[:, :count].copy()


@compiled
def _connected(runs: Runs, reach: int) -> Array:
    """Join the runs of each row to the overlapping runs of the row above (union-find), and return their boxes.

    `reach`: 1 if runs that touch at a corner overlap, else 0.
    """
    first, last, row = runs[0], runs[1], runs[2]
    parent = np.arange(runs.shape[1]).astype(np.int32)
    above = begin = 0  # first run of the row above, and of this row
    for k in range(runs.shape[1]):
        if k > 0 and row[k] != row[k - 1]:
            above, begin = begin if row[k] == row[k - 1] + 1 else k, k
        for j in range(above, begin):
            if first[j] > last[k] + reach:
                break
            if last[j] >= first[k] - reach:
                unite(parent, j, k)
    return _boxes(parent, first, last, row)


@inlined
def _boxes(
    parent: NDArray[np.int32], first: NDArray[np.int32], last: NDArray[np.int32], row: NDArray[np.int32]
) -> Array:
    """Return box and middle of every set of runs."""
    number = np.full(len(parent), -1, np.int32)
    sums = np.zeros((len(parent), 7))  # left, top, right, bottom, u, v, area
    count = 0
    for k in range(len(parent)):
        root = find(parent, k)
        if number[root] < 0:
            number[root] = count
            sums[count, 0], sums[count, 1] = first[k], row[k]
            count += 1
        part = sums[number[root]]
        length = last[k] - first[k] + 1
        part[0], part[2], part[3] = min(part[0], first[k]), max(part[2], last[k]), row[k]
        part[4] += 0.5 * length * (first[k] + last[k])
        part[5] += length * row[k]
        part[6] += length
    out = np.empty((count, 6))
    for k in range(count):
        part = sums[k]
        out[k, 0], out[k, 1] = part[0], part[1]
        out[k, 2], out[k, 3] = part[2] - part[0] + 1.0, part[3] - part[1] + 1.0
        out[k, 4], out[k, 5] = part[4] / part[6], part[5] / part[6]
    return out
