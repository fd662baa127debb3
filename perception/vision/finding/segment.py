"""Region growing on mean and variance (the paper's segmentation) in one deterministic raster pass.

A pixel joins the region above or to its left if it deviates from that region's mean by at most the tolerance or the
region's own spread; two regions that meet in a pixel and agree are merged (union-find, R. E. Tarjan, J. ACM 22(2),
1975). Sums are kept at the roots, so every region's size, mean, variance, middle and box are available when the pass
ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled, inlined
from hal.union_find import find
from perception.vision.noise import noise_sigma

TOLERANCE = 9.0  # gray levels; least tolerance
# Tolerance in sigmas of the noise; with less, thousands of single pixels remain, because bright parts are noisier.
NOISES = 6.0

Moments = tuple[np.int64, np.int64, np.int64]  # count, sum and sum of squares of gray levels
SPREADS = 2.0  # tolerance in standard deviations of the region itself


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageRegions:
    """Segmentation of an image.

    Attributes:
        labels: (H, W) int32, region of every pixel, 0 to N - 1, numbered in raster order of their first pixels.
        area_px, mean, variance: (N,) size, mean gray level and its variance.
        middle_px: (N, 2) u, v.
        box_px: (N, 4) u, v, width, height.
    """

    labels: NDArray[np.int32]
    area_px: Array
    mean: Array
    variance: Array
    middle_px: Array
    box_px: Array


def grow_regions(gray: Image, *, tolerance: float | None = None) -> ImageRegions:
    """Segment a gray image (H, W) uint8.

    Args:
        tolerance: largest deviation of a pixel from its region's mean, gray levels; None: from the noise of the image.
    """
    gray = np.ascontiguousarray(gray)
    if tolerance is None:
        tolerance = max(TOLERANCE, NOISES * noise_sigma(gray))
    labels, sums = _grow(gray, tolerance)
    count = sums[:, 0]
    mean = sums[:, 1] / count
    box = np.column_stack([sums[:, 5], sums[:, 7], sums[:, 6] - sums[:, 5] + 1, sums[:, 8] - sums[:, 7] + 1])
    return ImageRegions(
        labels=labels, area_px=count, mean=mean, variance=np.maximum(sums[:, 2] / count - mean**2, 0.0),
        middle_px=sums[:, 3:5] / count[:, None], box_px=box,
    )  # fmt: skip


@inlined
def _fits(n: np.int64, total: np.int64, squares: np.int64, value: np.int64, tolerance: float) -> bool:
    """Return whether a gray value belongs to a region: |I - mean| <= max(tolerance, SPREADS * sigma).

    `n`, `total`, `squares`: moments of the region. Square roots are avoided.
    """
    d = abs(value * n - total)  # n |I - mean|, without a division in the most frequent case
    if d <= tolerance * n:
        return True
    if d > 3.0 * tolerance * n:
        return False
    return bool(d * d <= SPREADS * SPREADS * (squares * n - total * total))


@inlined
def _moments(region: Array) -> Moments:
    """Return count, sum and sum of squares of a region's gray levels as integers, which add faster."""
    return np.int64(region[0]), np.int64(region[1]), np.int64(region[2])


@inlined
def _begin(sums: Array, parent: NDArray[np.int32], k: int, u: int, v: int) -> None:
    """Start an empty region at pixel (u, v)."""
    parent[k] = k
    sums[k] = 0.0
    sums[k, 5], sums[k, 6], sums[k, 7] = u, u, v


@inlined
def _joined(sums: Array, parent: NDArray[np.int32], a: int, b: int) -> int:
    """Merge the regions of two roots; returns the remaining root, the older one."""
    low, high = (a, b) if a < b else (b, a)
    parent[high] = low
    for j in range(5):
        sums[low, j] += sums[high, j]
    sums[low, 5] = min(sums[low, 5], sums[high, 5])
    sums[low, 6] = max(sums[low, 6], sums[high, 6])
    sums[low, 7] = min(sums[low, 7], sums[high, 7])
    sums[low, 8] = max(sums[low, 8], sums[high, 8])
    return low


@inlined
def _flush(sums: Array, k: int, moments: Moments, row: int, first: int, end: int) -> None:
    """Store the gray moments of region `k`, and add the positions of its run [first, end) in a row."""
    count = end - first
    region = sums[k]
    region[0], region[1], region[2] = moments
    region[3] += 0.5 * count * (first + end - 1)
    region[4] += count * row
    region[5] = min(region[5], first)
    region[6] = max(region[6], end - 1)
    region[8] = row


@compiled
def _grow(gray: Image, tolerance: float) -> tuple[NDArray[np.int32], Array]:  # noqa: PLR0912 - one case per neighbour  # pragma: no cover - compiled
    """Do the raster pass; returns raw labels (H, W) and the sums of every region.

    The region of the current run has its gray moments in registers (n, total, squares), because most pixels have the
    same region above and to the left, and then need only one comparison.
    """
    height, width = gray.shape
    labels = np.empty((height, width), np.int32)
    nothing = np.full(width, -1, np.int32)
    parent = np.empty(height * width // 16 + 16, np.int32)
    sums = np.empty((len(parent), 9))
    made = 0
    for v in range(height):
        left = -1
        above = up_root = -1  # raw label above and its root: looked up again only when the label changes
        n = total = squares = np.int64(0)
        first = 0
        grays, row, row_above = gray[v], labels[v], labels[v - 1] if v > 0 else nothing
        for u in range(width):
            value = np.int64(grays[u])
            if row_above[u] != above:
                above = row_above[u]
                up_root = find(parent, above)
            if up_root == left and left >= 0 and _fits(n, total, squares, value, tolerance):
                n, total, squares = n + 1, total + value, squares + value * value
                row[u] = left
                continue
            up = up_root if up_root != left else -1
            if up >= 0 and not _fits(sums[up, 0], sums[up, 1], sums[up, 2], value, tolerance):
                up = -1
            goes_on = left >= 0 and up_root != left and _fits(n, total, squares, value, tolerance)
            if goes_on and up >= 0:
                mean_up, mean_left = sums[up, 1] / sums[up, 0], total / n
                if -tolerance <= mean_up - mean_left <= tolerance:
                    _flush(sums, left, (n, total, squares), v, first, u)
                    left = up_root = _joined(sums, parent, up, left)
                    n, total, squares = _moments(sums[left])
                    first = u
                elif abs(value - mean_up) <= abs(value - mean_left):
                    goes_on = False
            if not goes_on:
                if left >= 0:
                    _flush(sums, left, (n, total, squares), v, first, u)
                if up >= 0:
                    left = up
                    n, total, squares = _moments(sums[up])
                else:
                    if made == len(parent):
                        parent, sums = _enlarged(parent, sums)
                    left = made
                    made += 1
                    _begin(sums, parent, left, u, v)
                    n = total = squares = np.int64(0)
                first = u
            n, total, squares = n + 1, total + value, squares + value * value
            row[u] = left
        _flush(sums, left, (n, total, squares), v, first, width)
    return _numbered(labels, parent[:made], sums)


@compiled
def _numbered(labels: NDArray[np.int32], parent: NDArray[np.int32], sums: Array) -> tuple[NDArray[np.int32], Array]:
    """Renumber the labels, in place, to 0 to N - 1 in the order of the roots; returns them and the roots' sums."""
    number = np.full(len(parent), -1, np.int32)
    out = np.empty((len(parent), 9))
    count = 0
    for k in range(len(parent)):
        if parent[k] == k:
            number[k] = count
            out[count] = sums[k]
            count += 1
    for k in range(len(parent)):
        number[k] = number[find(parent, k)]
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            labels[v, u] = number[labels[v, u]]
    return labels, out[:count].copy()


@compiled
def _enlarged(parent: NDArray[np.int32], sums: Array) -> tuple[NDArray[np.int32], Array]:
    """Return larger copies of both arrays."""
    more_parent = np.empty(2 * len(parent), np.int32)
    more_parent[: len(parent)] = parent
    more_sums = np.empty((2 * len(sums), sums.shape[1]))
    more_sums[: len(sums)] = sums
    return more_parent, more_sums
