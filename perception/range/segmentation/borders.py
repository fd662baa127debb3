"""Borders between touching regions, and the step and angle between their surfaces there."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Indices, Labels, Mask
from hal.jit import as_numpy_scalar, compiled
from perception.range.fitting.surfaces import depth_on, normal_on
from perception.range.segmentation.boundary_pixels import WORD, flagged
from perception.range.segmentation.grid import sigma_at

WIDEST_GAP_PX = 3  # most unlabelled pixels between touching labels: one block that no surface explained
PAIR_POINTS = 24  # contacts of a pair that are returned, evenly spread over its border
NONE_YET = as_numpy_scalar(0)


@compiled
def touching(labels: Labels, sen: Array) -> tuple[Labels, Indices, Array, Array]:
    """Find the pairs of labels that touch in an image (H, W) of labels.

    Returns the pairs (P, 2) of labels a < b, in order; the number of contacts (P,) of each pair, which measures the length
    of their border in pixels; and ray coordinates x, y (P, PAIR_POINTS) of some contacts, evenly spread over the border,
    unset beyond the number of contacts.
    """
    ids, us, vs = _contacts(labels, WIDEST_GAP_PX)
    count = labels.max() + 1
    of_id = np.zeros(count * count, np.int64)
    for i in ids:
        of_id[i] += 1
    there = np.flatnonzero(of_id)
    lengths = of_id[there]
    of_id[there] = np.arange(there.shape[0])
    pairs = np.empty((there.shape[0], 2), np.int32)
    for k in range(there.shape[0]):
        pairs[k, 0], pairs[k, 1] = there[k] // count, there[k] % count
    x, y = np.empty((there.shape[0], PAIR_POINTS)), np.empty((there.shape[0], PAIR_POINTS))
    seen, taken = np.zeros_like(lengths), np.zeros_like(lengths)
    for i in range(ids.shape[0]):
        k = of_id[ids[i]]
        most = min(lengths[k], PAIR_POINTS)
        if taken[k] < most and seen[k] == taken[k] * lengths[k] // most:
            x[k, taken[k]], y[k, taken[k]] = (us[i] - sen[3]) / sen[1], (vs[i] - sen[4]) / sen[2]
            taken[k] += 1
        seen[k] += 1
    return pairs, lengths, x, y


@compiled
def _contacts(labels: Labels, gap: int) -> tuple[Indices, Array, Array]:
    """Find where two labels meet along a row or a column, across at most `gap` unlabelled pixels, in raster order.

    Returns for each contact of labels a < b the number a (largest label + 1) + b, and its column and row.
    """
    H, W = labels.shape
    count = labels.max() + 1
    ids, us, vs = np.empty(8 * W, np.int64), np.empty(8 * W), np.empty(8 * W)
    above, above_at = np.zeros(W, np.int32), np.zeros(W, np.int32)
    words, columns = np.zeros(W // WORD + 1, np.uint64), np.empty(W + 1, np.int32)
    n = NONE_YET
    for v in range(H):
        if n + 2 * W > ids.shape[0]:
            ids, us, vs = np.concatenate((ids, ids)), np.concatenate((us, us)), np.concatenate((vs, vs))
        row = labels[v]
        _flag_ends(row, above, words.view(np.bool_))
        for at in range(flagged(words, columns)):
            u = columns[at]
            left_at = u - 1
            while left_at >= 0 and row[left_at] == 0 and u - left_at <= gap:
                left_at -= 1
            left = row[left_at] if left_at >= 0 else np.int32(0)
            for other, reach, x, y in (
                (left, u - left_at, 0.5 * (left_at + u), float(v)),
                (above[u], v - above_at[u], float(u), 0.5 * (above_at[u] + v)),
            ):
                if other != row[u] and other != 0 and reach <= gap + 1:
                    ids[n] = min(other, row[u]) * count + max(other, row[u])
                    us[n], vs[n] = x, y
                    n += 1
        _pass_row(row, v, above, above_at)
    return ids[:n].copy(), us[:n].copy(), vs[:n].copy()


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
