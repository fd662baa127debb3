"""The order in which blocks seed planes: flattest neighbourhood first."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels, Mask
from hal.jit import compiled

LEVELS = 64  # levels of flatness in the counting sort
LONE_BEND = 0.02  # 1 - cosine of the angle that is assumed towards a neighbour without a normal


@compiled
def seed_order(normal: Array, rms: Array, free: Mask, reach: int) -> Labels:
    """Return the flat indices of the free blocks with a tangent plane, flattest neighbourhood first (counting sort).

    Flatness is judged from the residual of the tangent plane and the angles to the normals `reach` blocks away on four
    sides.
    """
    h, w = rms.shape
    normals, known = _framed_normals(normal, rms, free, reach)
    cosine, bend, levels = np.empty(w), np.empty(w), np.empty((h, w), np.int32)
    starts = np.zeros(LEVELS + 1, np.int64)
    for r in range(h):
        if not known[r]:
            continue
        bend[:] = 0.0
        for i, j in ((2 * reach, reach), (0, reach), (reach, 2 * reach), (reach, 0)):
            cosine[:] = 0.0
            for k in range(3):
                _add_product(normals[k, r + reach, reach : reach + w], normals[k, r + i, j : j + w], cosine)
            _add_bend(cosine, bend)
        _fill_levels(bend, rms[r], normals[0, r + reach, reach : reach + w], levels[r])
        for c in range(w):
            if levels[r, c] >= 0:
                starts[levels[r, c] + 1] += 1
    for k in range(LEVELS):
        starts[k + 1] += starts[k]
    out = np.empty(starts[LEVELS], np.int32)
    for r in range(h):
        for c in range(w if known[r] else 0):
            level = levels[r, c]
            if level >= 0:
                out[starts[level]] = r * w + c
                starts[level] += 1
    return out


@compiled
def _framed_normals(normal: Array, rms: Array, free: Mask, reach: int) -> tuple[Array, Mask]:
    """Return the normals of free blocks as (3, h + 2 reach, w + 2 reach), and which rows have any.

    They are NaN where a block has no normal, and in the margin.
    """
    h, w = rms.shape
    out, known = np.full((3, h + 2 * reach, w + 2 * reach), np.nan), np.zeros(h, np.bool_)
    for r in range(h):
        for c in range(w):
            if free[r, c] and np.isfinite(rms[r, c]):
                known[r] = True
                for k in range(3):
                    out[k, r + reach, c + reach] = normal[r, c, k]
    return out, known


@compiled
def _add_product(a: Array, b: Array, out: Array) -> None:
    """Add a * b to `out`, elementwise."""
    for c in range(out.shape[0]):
        out[c] += a[c] * b[c]


@compiled
def _add_bend(cosine: Array, bend: Array) -> None:
    """Add the bend towards a neighbour: 1 - cosine of the angle between normals, `LONE_BEND` if one is NaN."""
    for c in range(bend.shape[0]):
        bend[c] += 1.0 - cosine[c] if cosine[c] == cosine[c] else LONE_BEND


@compiled
def _fill_levels(bend: Array, rms: Array, known: Array, levels: Labels) -> None:
    """Fill `levels`: 0 for a flat neighbourhood with small residuals, more for others, and -1 for a block without a normal."""
    for c in range(bend.shape[0]):
        level = min(LEVELS - 1.0, 12.0 * np.sqrt(max(25.0 * bend[c], 0.0)) + 4.0 * max(rms[c] - 1.0, 0.0))
        levels[c] = np.int32(level if known[c] == known[c] else -1.0)
