"""Connected components in horizontal tiles, and other work that tiles share.

The paper's five steps (Section III): tiles, a raster scan in each, exchange of border rows by cube doubling, merging,
relabelling. Here the exchange is a union-find over the seam rows, neighbours first, then pairs of pairs: log2(tiles)
rounds. Labels follow the raster order of each component's first pixel, so they are the same for any number of tiles.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]


def tile_rows(rows: int, tiles: int) -> list[tuple[int, int]]:
    """Row ranges [top, bottom) of at most `tiles` horizontal tiles, none empty."""
    count = min(max(tiles, 1), max(rows, 1))
    return [(rows * k // count, rows * (k + 1) // count) for k in range(count)]


def for_each_tile(
    work: Callable[[int, int], object], rows: int, tiles: int, *, pool: ThreadPoolExecutor | None
) -> None:
    """Call `work(top, bottom)` for every tile, on the pool's threads when one is given."""
    if tiles == 1:
        work(0, rows)
        return
    ranges = tile_rows(rows, tiles)
    if pool is None or len(ranges) == 1:
        for top, bottom in ranges:
            work(top, bottom)
        return
    for done in [pool.submit(work, top, bottom) for top, bottom in ranges]:
        done.result()


def label_components(
    mask: Flags, link_right: Flags, link_down: Flags, *, tiles: int = 1, pool: ThreadPoolExecutor | None = None
) -> tuple[Ints, Ints]:
    """Components of linked pixels.

    Args:
        mask: (H, W) pixels that take part.
        link_right: (H, W) whether pixel (v, u) belongs with (v, u + 1); the last column is not read.
        link_down: (H, W) whether (v, u) belongs with (v + 1, u); the last row is not read.

    Returns:
        labels (H, W) int32, 0 outside the mask, from 1 in raster order of first pixels; sizes (n + 1,), entry 0 unused.
    """
    H, W = mask.shape
    parent = np.arange(H * W, dtype=np.int32)
    for_each_tile(lambda top, bottom: _scan(mask, link_right, link_down, parent, top, bottom), H, tiles, pool=pool)
    seams = [top for top, _ in tile_rows(H, tiles)][1:]
    for round_seams in merge_rounds(seams):
        for seam in round_seams:
            _merge_seam(mask, link_down, parent, seam)
    labels, sizes = _relabel(mask, parent)
    return labels, sizes


def merge_rounds(seams: list[int]) -> list[list[int]]:
    """Seams in the order of cube doubling: the first round holds every second one, the last round a single one.

    Seams of one round join disjoint groups of tiles, so a round's merges may run at the same time.
    """
    rounds = []
    while seams:
        rounds.append(seams[::2])
        seams = seams[1::2]
    return rounds


@njit(cache=True, nogil=True)
def find(parent, i):  # type: ignore[no-untyped-def]  # numba types it
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def unite(parent, i, j):  # type: ignore[no-untyped-def]  # numba types it
    """The smaller index becomes the root: roots are first pixels in raster order."""
    a, b = find(parent, i), find(parent, j)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@njit(cache=True, nogil=True)
def _scan(mask, link_right, link_down, parent, top, bottom):  # type: ignore[no-untyped-def]  # numba types it
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


@njit(cache=True, nogil=True)
def _merge_seam(mask, link_down, parent, seam):  # type: ignore[no-untyped-def]  # numba types it
    W = mask.shape[1]
    for u in range(W):
        if mask[seam - 1, u] and mask[seam, u] and link_down[seam - 1, u]:
            unite(parent, (seam - 1) * W + u, seam * W + u)


@njit(cache=True, nogil=True)
def _relabel(mask, parent):  # type: ignore[no-untyped-def]  # numba types it
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
                flat[i] = flat[parent[i]]  # parents come first in raster order, so theirs is already known
            sizes[flat[i]] += 1
    return label, sizes[: found + 1].copy()
