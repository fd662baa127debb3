"""Run-length encoding of label images, which makes loops over a region short and free of branches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Indices, Labels, Mask
from hal.jit import compiled
from perception.range.segmentation.boundary_pixels import WORD, flagged


@compiled
def _flag_changes(own: Labels, flags: Mask) -> None:
    """Flag the pixels whose label differs from that of the pixel to their left."""
    flags[0] = False
    for u in range(1, own.shape[0]):
        flags[u] = own[u] != own[u - 1]


@compiled
def row_ends(own: Labels, words: NDArray[np.uint64], ends: Labels) -> int:
    """Write the ends of the runs of equal labels in a row (W,) into `ends` (W + 2,); returns the number of runs.

    `words` (W // 8 + 1,): work array for flags, initially zero.
    """
    _flag_changes(own, words.view(np.bool_))
    count = flagged(words, ends)
    ends[count] = own.shape[0]
    return count + 1


@compiled
def runs_of(labels: Labels, count: int) -> tuple[Indices, Labels, Indices]:
    """Return the runs of labels 1 to `count` in the rows of `labels` (H, W), grouped by label, in raster order.

    Returns `starts` (count + 2,): label k owns runs[starts[k] : starts[k + 1]]; the runs (R, 3): row, first column and
    the column after the last; and the number of pixels of each label (count + 1,), entry 0 unused.
    """
    H, W = labels.shape
    words, ends = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 2, np.int32)
    met, n = np.empty((4 * max(H, W), 4), np.int32), 0
    starts, pixels = np.zeros(count + 2, np.int64), np.zeros(count + 1, np.int64)
    for v in range(H):
        if n + W > met.shape[0]:
            met = np.concatenate((met, met))
        first = 0
        for i in range(row_ends(labels[v], words, ends)):
            k = labels[v, first]
            if k > 0:
                met[n, 0], met[n, 1], met[n, 2], met[n, 3] = k, v, first, ends[i]
                starts[k + 1] += 1
                pixels[k] += ends[i] - first
                n += 1
            first = ends[i]
    for k in range(count + 1):
        starts[k + 1] += starts[k]
    place, runs = starts.copy(), np.empty((n, 3), np.int32)
    for i in range(n):
        k = met[i, 0]
        for a in range(3):
            runs[place[k], a] = met[i, 1 + a]
        place[k] += 1
    return starts, runs, pixels


@compiled
def painted(starts: Indices, runs: Labels, names: Labels, labels: Labels) -> None:
    """Write label `names[k]` over the runs of each k into `labels` (H, W), which is zero."""
    for k in range(1, names.shape[0]):
        for i in range(starts[k], starts[k + 1]):
            row = labels[runs[i, 0]]
            for u in range(runs[i, 1], runs[i, 2]):
                row[u] = names[k]


@compiled
def places_of(runs: Labels, width: int) -> Labels:
    """Return the flat pixel indices (N,) of runs (R, 3) in an image of the given width."""
    out, n = np.empty(np.sum(runs[:, 2] - runs[:, 1]), np.int32), 0
    for i in range(runs.shape[0]):
        for u in range(runs[i, 1], runs[i, 2]):
            out[n] = runs[i, 0] * width + u
            n += 1
    return out
