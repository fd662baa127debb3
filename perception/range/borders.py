"""Where two regions touch, and what their models say there: a step, a crease, or one smooth surface cut in two."""

# bodies and plain comparisons are what compiles fast.
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.range.grid import sigma_at
from perception.range.surfaces import depth_on, normal_on

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

WIDEST_GAP_PX = 3  # unlabelled pixels that a border may hold: one block of pixels that no model claimed
PAIR_POINTS = 24


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Border:
    """Up to `PAIR_POINTS` places (x, y) along the border of two regions, and its whole length in pixels."""

    x: Array
    y: Array
    length_px: int

    def with_more(self, other: Border) -> Border:
        """Both borders as one."""
        return Border(
            x=np.concatenate([self.x, other.x]),
            y=np.concatenate([self.y, other.y]),
            length_px=self.length_px + other.length_px,
        )


def borders_of(labels: Ints, packed: Array) -> dict[tuple[int, int], Border]:
    """Every pair of labels (a < b) that touch in (H, W) `labels`, with places on their border as ray coordinates."""
    keys, u, v = _contacts(labels, WIDEST_GAP_PX)
    if keys.size == 0:
        return {}
    order = np.argsort(keys, kind="stable")
    keys, u, v = keys[order], u[order], v[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    ends = np.append(starts[1:], keys.size)
    out = {}
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        count = min(end - start, PAIR_POINTS)
        pick = start + (np.arange(count) * (end - start)) // count
        pair = (int(keys[start] >> 32), int(keys[start] & 0xFFFFFFFF))
        x, y = (u[pick] - packed[3]) / packed[1], (v[pick] - packed[4]) / packed[2]
        out[pair] = Border(x=x, y=y, length_px=end - start)
    return out


@njit(cache=True)
def _contacts(labels, gap):  # type: ignore[no-untyped-def]
    """Pair key (a << 32 | b, a < b) and place of each contact along rows and columns, over at most `gap` zeros."""
    H, W = labels.shape
    keys, us, vs = np.empty(8 * W, np.int64), np.empty(8 * W), np.empty(8 * W)
    above, above_at = np.zeros(W, np.int32), np.zeros(W, np.int32)
    n = 0
    for v in range(H):
        if n + 2 * W > keys.shape[0]:
            keys, us, vs = (
                np.concatenate((keys, np.empty_like(keys))),
                np.concatenate((us, np.empty_like(us))),
                np.concatenate((vs, np.empty_like(vs))),
            )
        left, left_at = 0, -1
        for u in range(W):
            label = labels[v, u]
            if label == 0:
                continue
            if left != label and left > 0 and u - left_at <= gap + 1:
                keys[n] = (min(left, label) << 32) | max(left, label)
                us[n], vs[n] = 0.5 * (left_at + u), v
                n += 1
            left, left_at = label, u
            upper = above[u]
            if upper != label and upper > 0 and v - above_at[u] <= gap + 1:
                keys[n] = (min(upper, label) << 32) | max(upper, label)
                us[n], vs[n] = u, 0.5 * (above_at[u] + v)
                n += 1
            above[u], above_at[u] = label, v
    return keys[:n].copy(), us[:n].copy(), vs[:n].copy()


@njit(cache=True)
def step_and_turn(kind_a, a, kind_b, b, x, y, noise, perspective):  # type: ignore[no-untyped-def]
    """Median step in sigmas and median turn in radians between two surfaces at the rays (x, y).

    A ray that misses one of the surfaces counts as an endless step; a turn is read where both are met.
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
