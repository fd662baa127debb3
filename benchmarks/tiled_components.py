"""Labels connected components in horizontal tiles, as the paper does on a hypercube (Section III, Fig. 9).

The paper's five steps are: division into tiles, a raster scan of each, exchange of border rows by cube doubling,
merging, relabelling. Here the exchange is a union-find over the seam rows, first of neighbours, then of pairs of pairs,
in log2(tiles) rounds. Labels follow the raster order of each component's first pixel, so they do not depend on the
number of tiles.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from hal.arrays import Indices, Labels, Mask
from hal.jit import compiled
from hal.union_find import unite
from perception.range.tiles import for_each_tile, tile_rows


def label_components(
    mask: Mask, link_right: Mask, link_down: Mask, *, tiles: int = 1, pool: ThreadPoolExecutor | None = None
) -> tuple[Labels, Labels]:
    """Return the components of linked pixels.

    Args:
        mask: (H, W) pixels to be labelled.
        link_right: (H, W) whether pixel (v, u) is connected to (v, u + 1); the last column is not read.
        link_down: (H, W) whether (v, u) is connected to (v + 1, u); the last row is not read.

    Returns:
        labels (H, W) int32, 0 outside the mask, from 1 in raster order of first pixels; sizes (n + 1,), entry 0 unused.
    """
    H, W = mask.shape
    parent = np.arange(H * W)
    for_each_tile(lambda top, bottom: _scan(mask, link_right, link_down, parent, top, bottom), H, tiles, pool=pool)
    seams = [top for top, _ in tile_rows(H, tiles)][1:]
    for round_seams in merge_rounds(seams):
        for seam in round_seams:
            _merge_seam(mask, link_down, parent, seam)
    labels, sizes = _relabel(mask, parent)
    return labels, sizes


def merge_rounds(seams: list[int]) -> list[list[int]]:
    """Return the seams in the order of cube doubling: every second one in the first round, a single one in the last.

    The seams of one round join disjoint groups of tiles, so the merges of a round can run in parallel.
    """
    rounds = []
    while seams:
        rounds.append(seams[::2])
        seams = seams[1::2]
    return rounds


@compiled
def _scan(mask: Mask, link_right: Mask, link_down: Mask, parent: Indices, top: int, bottom: int) -> None:
    W = mask.shape[1]
    for v in range(top, bottom):
        for u in range(W):
            if not mask[v, u]:
                continue
            i = v * W + u
            if u > 0 and link_right[v, u - 1] and mask[v, u - 1]:
                parent[i] = parent[i - 1]
            if v > top and link_down[v - 1, u] and mask[v - 1, u] and parent[i - W] != parent[i]:
                unite(parent, i - W, i)


@compiled
def _merge_seam(mask: Mask, link_down: Mask, parent: Indices, seam: int) -> None:
    W = mask.shape[1]
    for u in range(W):
        if mask[seam - 1, u] and mask[seam, u] and link_down[seam - 1, u]:
            unite(parent, (seam - 1) * W + u, seam * W + u)


@compiled
def _relabel(mask: Mask, parent: Indices) -> tuple[Labels, Labels]:
    H, W = mask.shape
    label = np.zeros((H, W), np.int32)
    sizes = np.zeros(H * W + 1, np.int32)
    flat = label.ravel()
    found = 0
    for v in range(H):
        for u in range(W):
            if not mask[v, u]:
                continue
            i = v * W + u
            if parent[i] == i:
                found += 1
                flat[i] = found
            else:
                flat[i] = flat[parent[i]]  # a parent comes first in raster order, so its label is already known
            sizes[flat[i]] += 1
    return label, sizes[: found + 1].copy()
