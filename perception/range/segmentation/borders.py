"""Borders between touching regions, and the step and angle between their surfaces there."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting.surfaces import depth_on, normal_on
from perception.range.segmentation.boundary_pixels import WORD, flagged
from perception.range.segmentation.grid import sigma_at
from perception.range.segmentation.pixel_assignment import bucket

WIDEST_GAP_PX = 3  # most unlabelled pixels between touching labels: one block that no surface explained
PAIR_POINTS = 24  # contacts of a pair that are returned, evenly spread over its border
NONE_YET = as_numpy_scalar(0)


@compiled
def touching(labels: Labels, sen: Array) -> tuple[Labels, Indices, Array, Array]:
    """Find the pairs of labels that touch in an image (H, W) of labels.

    Returns the pairs (P, 2) of labels a < b; the number of contacts (P,) of each pair, which measures the length of their
    border in pixels; and ray coordinates x, y (P, PAIR_POINTS) of some contacts, unset beyond the number of contacts.
    """
    ids, us, vs, pairs = _contacts(labels, WIDEST_GAP_PX)
    starts, order = bucket(ids, pairs.shape[0])
    lengths = starts[2:] - starts[1:-1]
    x, y = np.empty((pairs.shape[0], PAIR_POINTS)), np.empty((pairs.shape[0], PAIR_POINTS))
    for k in range(pairs.shape[0]):
        count = min(lengths[k], PAIR_POINTS)
        for j in range(count):
            i = order[starts[k + 1] + (j * lengths[k]) // count]
            x[k, j], y[k, j] = (us[i] - sen[3]) / sen[1], (vs[i] - sen[4]) / sen[2]
    return pairs, lengths, x, y


@compiled
def _contacts(labels: Labels, gap: int) -> tuple[Labels, Array, Array, Labels]:
    """Find where two labels meet along a row or a column, across at most `gap` unlabelled pixels, in raster order.

    Returns for each contact the number of its pair (from 1) and its column and row; and the pairs (P, 2), a < b, in
    order of their first contact.
    """
    H, W = labels.shape
    ids, us, vs = np.empty(8 * W, np.int32), np.empty(8 * W), np.empty(8 * W)
    above, above_at = np.zeros(W, np.int32), np.zeros(W, np.int32)
    # The pairs with the same smaller label form a linked list, which is short because no label has many neighbours.
    newest = np.zeros(labels.max() + 1, np.int32)
    pairs, older = np.empty((4 * W, 2), np.int32), np.empty(4 * W + 1, np.int32)
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    n, count = NONE_YET, NONE_YET
    for v in range(H):
        if n + 2 * W > ids.shape[0]:
            ids, us, vs = (
                np.concatenate((ids, np.empty_like(ids))),
                np.concatenate((us, np.empty_like(us))),
                np.concatenate((vs, np.empty_like(vs))),
            )
        if count + 2 * W > pairs.shape[0]:
            pairs, older = np.concatenate((pairs, np.empty_like(pairs))), np.concatenate((older, np.empty_like(older)))
        _flag_ends(labels[v], above, words.view(np.bool_))
        ends = columns[: flagged(words, columns)]
        n, count = _add_contacts(labels[v], v, ends, gap, above, above_at, newest, pairs, older, count, ids, us, vs, n)
        _pass_row(labels[v], v, above, above_at)
    return ids[:n].copy(), us[:n].copy(), vs[:n].copy(), pairs[:count].copy()


@compiled
def _add_contacts(
    row: Labels, v: int, ends: Labels, gap: int, above: Labels, above_at: Labels, newest: Labels, pairs: Labels,
    older: Labels, count: int, ids: Labels, us: Array, vs: Array, n: int,
) -> tuple[int, int]:  # fmt: skip
    """Append the contacts of row v in the columns `ends` to the `n` contacts and `count` pairs; returns both new numbers.

    `above` and `above_at` hold the last label above each column and its row; `newest` and `older` are the linked lists of
    the pairs.
    """
    for at in range(ends.shape[0]):
        u = ends[at]
        label, left_at = row[u], u - 1
        while left_at >= 0 and row[left_at] == 0 and u - left_at <= gap:
            left_at -= 1
        for side in range(2):
            if side == 0:
                other, reach = row[left_at] if left_at >= 0 else 0, u - left_at
            else:
                other, reach = above[u], v - above_at[u]
            if other == label or other == 0 or reach > gap + 1:  # noqa: PLR1714 - numba knows no `in` of mixed integers
                continue
            a, b = min(other, label), max(other, label)
            k = newest[a]
            while k > 0 and pairs[k - 1, 1] != b:
                k = older[k]
            if k == 0:
                pairs[count, 0], pairs[count, 1] = a, b
                count += 1
                k, older[count], newest[a] = count, newest[a], count
            ids[n] = k
            us[n] = 0.5 * (left_at + u) if side == 0 else u
            vs[n] = v if side == 0 else 0.5 * (above_at[u] + v)
            n += 1
    return n, count


@compiled
def _flag_ends(row: Labels, above: Labels, flags: Mask) -> None:
    """Flag labelled pixels whose label differs from that of the pixel to the left or of the last labelled pixel above."""
    flags[0] = row[0] > 0
    for u in range(1, row.shape[0]):
        flags[u] = (row[u] > 0) & ((row[u] != row[u - 1]) | (row[u] != above[u]))


@compiled
def _pass_row(row: Labels, v: int, above: Labels, above_at: Labels) -> None:
    """Update the last label above each column, and its row, with the labelled pixels of row v."""
    now = np.int32(v)
    for u in range(row.shape[0]):
        above_at[u] = now if row[u] > 0 else above_at[u]
    for u in range(row.shape[0]):
        above[u] = row[u] if row[u] > 0 else above[u]


@compiled
def step_and_turn(
    kind_a: int, a: Array, kind_b: int, b: Array, x: Array, y: Array, noise: Array, perspective: bool,
) -> tuple[float, float]:  # fmt: skip
    """Return the median depth step in sigmas and the median angle in radians between two surfaces at the rays (x, y).

    A ray that misses one of the surfaces counts as an infinite step; the angle uses only rays that hit both.
    """
    n = x.shape[0]
    steps, turns = np.empty(n), np.empty(n)
    met = 0
    for i in range(n):
        za, zb = depth_on(kind_a, a, x[i], y[i], perspective), depth_on(kind_b, b, x[i], y[i], perspective)
        if not np.isfinite(za + zb):
            steps[i] = np.inf
            continue
        steps[i] = abs(za - zb) / sigma_at(noise, min(za, zb))
        ax, ay, az = normal_on(kind_a, a, x[i] * za if perspective else x[i], y[i] * za if perspective else y[i], za)
        bx, by, bz = normal_on(kind_b, b, x[i] * zb if perspective else x[i], y[i] * zb if perspective else y[i], zb)
        facing_a = ax * x[i] + ay * y[i] + az if perspective else az
        facing_b = bx * x[i] + by * y[i] + bz if perspective else bz
        dot = ax * bx + ay * by + az * bz
        if facing_a * facing_b < 0.0:
            dot = -dot
        turns[met] = np.arccos(min(1.0, max(-1.0, dot)))
        met += 1
    if met == 0:
        return np.inf, np.inf
    return np.median(steps), np.median(turns[:met])
