"""What no surface explains yet: unlabelled patches that are large enough to hold one."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.components import find, unite

Array = NDArray[np.float64]
Labels = NDArray[np.int32]


def unexplained(
    depth_m: Array, labels: Labels, least_pixels: int, *, align_px: int
) -> tuple[tuple[int, int], Array] | None:
    """The least part of the image that holds every unlabelled patch of at least `least_pixels`, None without any.

    Patches are connected over sides and corners. Returns the part's first row and column, multiples of `align_px`, and
    its depth, NaN outside of those patches.
    """
    top, left, part = _patches(depth_m, labels, least_pixels, align_px)
    return ((top, left), part) if part.size else None


@njit(cache=True, nogil=True)
def _patches(depth, labels, least, align):  # type: ignore[no-untyped-def]  # numba types it
    H, W = depth.shape
    parent, free, count = np.full(H * W, np.int32(-1)), np.empty(H * W, np.int32), 0
    for v in range(H):
        for u in range(W):
            if labels[v, u] != 0 or not np.isfinite(depth[v, u]):
                continue
            i = v * W + u
            parent[i] = i
            free[count] = i
            count += 1
            if u > 0 and parent[i - 1] >= 0:
                unite(parent, i, i - 1)
            if v > 0 and parent[i - W] >= 0:
                unite(parent, i, i - W)  # and with it both of the upper corners
                continue
            if v > 0 and u > 0 and parent[i - W - 1] >= 0:
                unite(parent, i, i - W - 1)
            if v > 0 and u + 1 < W and parent[i - W + 1] >= 0:
                unite(parent, i, i - W + 1)
    sizes = np.zeros(H * W, np.int32)
    for k in range(count):
        sizes[find(parent, free[k])] += 1
    top, left, bottom, right, kept = H, W, 0, 0, 0
    for k in range(count):
        i = free[k]
        if sizes[find(parent, i)] < least:
            continue
        free[kept] = i
        kept += 1
        v, u = i // W, i % W
        top, bottom, left, right = min(top, v), max(bottom, v + 1), min(left, u), max(right, u + 1)
    if kept == 0:
        return 0, 0, np.empty((0, 0))
    top, left = top // align * align, left // align * align
    part = np.full((bottom - top, right - left), np.nan)
    for k in range(kept):
        v, u = free[k] // W, free[k] % W
        part[v - top, u - left] = depth[v, u]
    return top, left, part
