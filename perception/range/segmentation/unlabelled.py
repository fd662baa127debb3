"""Search for unlabelled patches that are large enough to hold a surface."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels
from hal.jit import compiled
from hal.union_find import find, unite
from perception.range.segmentation.boundary_pixels import WORD
from perception.range.segmentation.run_length import row_ends


def unlabelled_patches(
    depth_m: Array, labels: Labels, least_pixels: int, *, align_px: int
) -> tuple[tuple[int, int], Array] | None:
    """Return the smallest part of the image that holds all unlabelled patches of at least `least_pixels` pixels.

    Patches are connected over sides and corners. Returns the part's first row and column, which are multiples of
    `align_px`, and its depth, which is NaN outside these patches; None if there is no such patch.
    """
    top, left, part = _patches(depth_m, labels, least_pixels, align_px)
    return ((top, left), part) if part.size else None


@compiled
def _patches(depth: Array, labels: Labels, least: int, align: int) -> tuple[int, int, Array]:
    """Return first row, first column and depth of the part that `unlabelled_patches` describes; empty without patches."""
    H, W = depth.shape
    runs, begins = _free_runs(depth, labels)
    parent = _connected(runs, begins)
    sizes, kept = np.zeros(runs.shape[0], np.int64), np.zeros(runs.shape[0], np.bool_)
    for i in range(runs.shape[0]):
        sizes[find(parent, i)] += runs[i, 2] - runs[i, 1]
    top, left, bottom, right = H, W, 0, 0
    for i in range(runs.shape[0]):
        kept[i] = sizes[find(parent, i)] >= least
        if kept[i]:
            v, first, end = runs[i]
            top, bottom, left, right = min(top, v), max(bottom, v + 1), min(left, first), max(right, end)
    if bottom == 0:
        return 0, 0, np.empty((0, 0))
    top, left = top // align * align, left // align * align
    part = np.full((bottom - top, right - left), np.nan)
    for i in range(runs.shape[0]):
        if kept[i]:
            v, first, end = runs[i]
            part[v - top, first - left : end - left] = depth[v, first:end]
    return top, left, part


@compiled
def _free_runs(depth: Array, labels: Labels) -> tuple[Labels, Indices]:
    """Return the runs (R, 3) of unlabelled pixels with a reading, and the index (H + 1,) of each row's first run.

    A run is row, first column and the column after the last.
    """
    H, W = depth.shape
    words, ends = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 2, np.int32)
    runs, begins, n = np.empty((4 * max(H, W), 3), np.int32), np.zeros(H + 1, np.int64), 0
    for v in range(H):
        if n + W > runs.shape[0]:
            runs = np.concatenate((runs, runs))
        u = 0
        for i in range(row_ends(labels[v], words, ends)):
            u = ends[i] if labels[v, u] else u
            while u < ends[i]:
                first = u
                while u < ends[i] and np.isfinite(depth[v, u]):
                    u += 1
                if u > first:
                    runs[n, 0], runs[n, 1], runs[n, 2] = v, first, u
                    n += 1
                else:
                    u += 1
        begins[v + 1] = n
    return runs[:n].copy(), begins


@compiled
def _connected(runs: Labels, begins: Indices) -> Indices:
    """Return the union-find parents (R,) of the runs; runs that touch, even at a corner, have the same root."""
    parent = np.arange(runs.shape[0])
    for v in range(1, begins.shape[0] - 1):
        above = begins[v - 1]
        for i in range(begins[v], begins[v + 1]):
            while above < begins[v] and runs[above, 2] < runs[i, 1]:
                above += 1
            j = above
            while j < begins[v] and runs[j, 1] <= runs[i, 2]:
                unite(parent, i, j)
                j += 1
    return parent
