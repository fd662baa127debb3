"""Region growing on mean and variance (the paper's segmentation), one raster pass with region sums, deterministic.

A pixel joins the region above or to its left whose mean it does not leave by more than the tolerance and the region's own
spread; two regions that meet in a pixel and agree become one (union-find, R. E. Tarjan, J. ACM 22(2), 1975). Sums are kept
at the roots, so every region's size, mean, variance, middle and box are there when the pass ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.vision.image import Image
from perception.vision.view import Array

TOLERANCE = 9.0  # gray levels: three sigmas of a noisy 8-bit camera
SPREADS = 2.0  # of the region's own standard deviation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regions:
    """Segmentation of an image.

    Attributes:
        labels: (H, W) int32, region of every pixel, 0 to N - 1, numbered in raster order of their first pixels.
        area_px, mean, variance: (N,) size, gray level and its variance.
        middle_px: (N, 2) u, v.
        box_px: (N, 4) u, v, width, height.
    """

    labels: NDArray[np.int32]
    area_px: Array
    mean: Array
    variance: Array
    middle_px: Array
    box_px: Array


def grow_regions(gray: Image, *, tolerance: float = TOLERANCE) -> Regions:
    """Segment a gray image (H, W) uint8."""
    labels, sums = _grow(np.ascontiguousarray(gray), tolerance, SPREADS)
    count = sums[:, 0]
    mean = sums[:, 1] / count
    box = np.column_stack([sums[:, 5], sums[:, 7], sums[:, 6] - sums[:, 5] + 1, sums[:, 8] - sums[:, 7] + 1])
    return Regions(
        labels=labels, area_px=count, mean=mean, variance=np.maximum(sums[:, 2] / count - mean**2, 0.0),
        middle_px=sums[:, 3:5] / count[:, None], box_px=box,
    )  # fmt: skip


@njit(cache=True, inline="always")
def _root(parent: NDArray[np.int32], k: int) -> int:  # pragma: no cover
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@njit(cache=True, inline="always")
def _fits(sums: Array, k: int, value: float, tolerance: float, spreads: float) -> bool:  # pragma: no cover
    """Whether a gray value belongs to a region: |I - mean| <= max(tolerance, spreads * sigma), no roots."""
    n, total = sums[k, 0], sums[k, 1]
    d = abs(value * n - total)  # n |I - mean|: no division on the common path
    if d <= tolerance * n:
        return True
    if d > 3.0 * tolerance * n:
        return False
    return bool(d * d <= spreads * spreads * (sums[k, 2] * n - total * total))


@njit(cache=True)
def _grow(  # noqa: PLR0912, PLR0915  (one pass: calls would cost more than what they do)
    gray: Image, tolerance: float, spreads: float
) -> tuple[NDArray[np.int32], Array]:  # pragma: no cover
    height, width = gray.shape
    labels = np.empty((height, width), np.int32)
    capacity = height * width // 4 + 16
    parent = np.empty(capacity, np.int32)
    sums = np.zeros((capacity, 9))
    made = 0
    for v in range(height):
        left = -1
        for u in range(width):
            value = float(gray[v, u])
            up = _root(parent, labels[v - 1, u]) if v > 0 else -1
            if up == left:
                if up >= 0 and not _fits(sums, up, value, tolerance, spreads):
                    up = left = -1
            else:
                if up >= 0 and not _fits(sums, up, value, tolerance, spreads):
                    up = -1
                if left >= 0 and not _fits(sums, left, value, tolerance, spreads):
                    left = -1
            if up >= 0 and left >= 0 and up != left:
                difference = sums[up, 1] / sums[up, 0] - sums[left, 1] / sums[left, 0]
                if -tolerance <= difference <= tolerance:
                    low, high = (up, left) if up < left else (left, up)
                    parent[high] = low
                    for j in range(5):
                        sums[low, j] += sums[high, j]
                    sums[low, 5] = min(sums[low, 5], sums[high, 5])
                    sums[low, 6] = max(sums[low, 6], sums[high, 6])
                    sums[low, 7] = min(sums[low, 7], sums[high, 7])
                    sums[low, 8] = max(sums[low, 8], sums[high, 8])
                    k = low
                else:
                    k = (
                        up
                        if abs(value - sums[up, 1] / sums[up, 0]) <= abs(value - sums[left, 1] / sums[left, 0])
                        else left
                    )
            elif up >= 0:
                k = up
            elif left >= 0:
                k = left
            else:
                if made == capacity:
                    parent, sums = _enlarged(parent, sums)
                    capacity = len(parent)
                k = made
                made += 1
                parent[k] = k
                sums[k, 5], sums[k, 6], sums[k, 7], sums[k, 8] = u, u, v, v
            row = sums[k]
            row[0] += 1.0
            row[1] += value
            row[2] += value * value
            row[3] += u
            row[4] += v
            row[5] = min(row[5], u)
            row[6] = max(row[6], u)
            row[8] = v
            labels[v, u] = k
            left = k
    number = np.full(made, -1, np.int32)
    count = 0
    out = np.empty((made, 9))
    for k in range(made):
        if parent[k] == k:
            number[k] = count
            out[count] = sums[k]
            count += 1
    for k in range(made):
        number[k] = number[_root(parent, k)]
    for v in range(height):
        for u in range(width):
            labels[v, u] = number[labels[v, u]]
    return labels, out[:count].copy()


@njit(cache=True)
def _enlarged(parent: NDArray[np.int32], sums: Array) -> tuple[NDArray[np.int32], Array]:  # pragma: no cover
    more_parent = np.empty(2 * len(parent), np.int32)
    more_parent[: len(parent)] = parent
    more_sums = np.zeros((2 * len(sums), sums.shape[1]))
    more_sums[: len(sums)] = sums
    return more_parent, more_sums
