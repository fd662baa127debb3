"""Search for the pixels that have a neighbour with another label; only their labels may need to change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Labels, Mask
from hal.jit import compiled

WORD = 8  # flags per 64-bit word, which are tested together


@compiled
def contested_pixels(labels: Labels, newest: int, top: int, bottom: int) -> tuple[Labels, Labels]:
    """Find pixels whose 3x3 neighbourhood has a label other than theirs, and one that is at least `newest`.

    Searches the rows [top, bottom) of `labels` (H, W) int32; returns rows and columns (N,) int32, in raster order.
    """
    W = labels.shape[1]
    least, most = new_columns(W)
    words = np.zeros(W // WORD + 1, np.uint64)
    rows, columns = np.empty(4 * W, np.int32), np.empty(4 * W, np.int32)
    n = 0
    for v in range(top, bottom):
        if n + W >= rows.shape[0]:
            rows, columns = np.concatenate((rows, rows)), np.concatenate((columns, columns))
        column_range(labels, v, least, most)
        _flag_contested(labels[v], least, most, newest, words.view(np.bool_))
        count = flagged(words, columns[n:])
        rows[n : n + count] = v
        n += count
    return rows[:n].copy(), columns[:n].copy()


@compiled
def new_columns(width: int) -> tuple[NDArray[np.uint32], Labels]:
    """Allocate the arrays (width + 2,) that `column_range` fills; the first and last entries stand for no label."""
    return np.full(width + 2, np.uint32(0xFFFFFFFF)), np.zeros(width + 2, np.int32)


@compiled
def column_range(labels: Labels, v: int, least: NDArray[np.uint32], most: Labels) -> None:
    """Compute the least and the largest label of each column of the three rows around row v.

    `least` holds labels minus one as unsigned numbers, so that label 0 (none) becomes the largest.
    """
    one, last = np.int32(1), labels.shape[0] - 1
    above, own, below = labels[max(v - 1, 0)], labels[v], labels[min(v + 1, last)]
    low, high = least[1:-1], most[1:-1]
    for u in range(own.shape[0]):
        high[u] = max(above[u], own[u], below[u])
        low[u] = min(np.uint32(above[u] - one), np.uint32(own[u] - one), np.uint32(below[u] - one))


@compiled
def _flag_contested(own: Labels, least: NDArray[np.uint32], most: Labels, newest: int, flags: Mask) -> None:
    """Flag pixels whose 3x3 neighbourhood has a label other than their own, and one that is at least `newest`."""
    one = np.int32(1)
    for u in range(own.shape[0]):
        k = own[u]
        low, high = min(least[u], least[u + 1], least[u + 2]), max(most[u], most[u + 1], most[u + 2])
        flags[u] = ((high != k) | ((k > 0) & (low != np.uint32(k - one)))) & (high >= newest)


@compiled
def flagged(words: NDArray[np.uint64], places: Labels) -> int:
    """Write the indices of the flags set in `words`, ascending, into `places`; returns their number.

    `words` are flags of one byte each, seen as 64-bit numbers: eight are tested at a time, because few are set. `places`
    needs room for one more index than there are flags set.
    """
    flags = words.view(np.bool_)
    n = 0
    for k in range(words.shape[0]):
        if words[k] == 0:
            continue
        for i in range(WORD * k, WORD * k + WORD):
            places[n] = i
            n += flags[i]
    return n


@compiled
def flag_free(labels: Labels, flags: Mask) -> None:
    """Flag the unlabelled pixels of a row."""
    for u in range(labels.shape[0]):
        flags[u] = labels[u] == 0


@compiled
def pixels_around(rows: Labels, columns: Labels, reach: int, shape: tuple[int, int]) -> tuple[Labels, Labels]:
    """Return rows and columns of all pixels within `reach` rows and columns of the given ones, each pixel once."""
    H, W = shape
    seen = np.zeros((H, W), np.bool_)
    side = 2 * reach + 1
    out_rows, out_columns = (
        np.empty(rows.shape[0] * side * side, np.int32),
        np.empty(rows.shape[0] * side * side, np.int32),
    )
    n = 0
    for k in range(rows.shape[0]):
        for v in range(max(rows[k] - reach, 0), min(rows[k] + reach + 1, H)):
            for u in range(max(columns[k] - reach, 0), min(columns[k] + reach + 1, W)):
                if not seen[v, u]:
                    seen[v, u] = True
                    out_rows[n], out_columns[n] = v, u
                    n += 1
    return out_rows[:n].copy(), out_columns[:n].copy()


@compiled
def renamed_pixels(labels: Labels, rows: Labels, columns: Labels, names: Labels) -> tuple[Labels, Labels]:
    """Write the new labels `names` of the pixels, in place; returns rows and columns of those that changed."""
    moved_rows, moved_columns = np.empty_like(rows), np.empty_like(columns)
    n = 0
    for k in range(rows.shape[0]):
        v, u = rows[k], columns[k]
        if labels[v, u] != names[k]:
            labels[v, u] = names[k]
            moved_rows[n], moved_columns[n] = v, u
            n += 1
    return moved_rows[:n], moved_columns[:n]
