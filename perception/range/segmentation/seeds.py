"""The order in which blocks seed planes: flattest neighbourhood first."""

from __future__ import annotations

import numpy as np

from hal.arrays import Image, Indices, Mask
from hal.jit import compiled
from perception.range.segmentation.grid import Grid

LEVELS = 64  # levels of flatness
NO_SEED = 255  # level of a block without a normal
LONE_BEND = 0.02  # 1 - cosine of the angle that is assumed towards a neighbour without a normal


def seed_order(grid: Grid, free: Mask, reach: int) -> Indices:
    """Return the flat indices of the free blocks with a tangent plane, flattest neighbourhood first.

    Flatness is judged from the residual of the tangent plane and the angles to the normals `reach` blocks away on four
    sides.
    """
    levels = _levels(grid, free & np.isfinite(grid.rms), reach).ravel()
    order = np.argsort(levels, kind="stable")  # of bytes, so it takes a time proportional to their number
    return order[: np.count_nonzero(levels != NO_SEED)]


@compiled
def _levels(grid: Grid, known: Mask, reach: int) -> Image:
    """Return the level (h, w) of each block: 0 for a flat neighbourhood with small residuals, more for others.

    `known` (h, w): free blocks with a tangent plane; the others are no seeds.
    """
    normal, rms = grid.normal, grid.rms
    h, w = rms.shape
    levels = np.full((h, w), NO_SEED, np.uint8)
    for r in range(h):
        for c in range(w):
            if not known[r, c]:
                continue
            bend = 0.0
            for i, j in ((r + reach, c), (r - reach, c), (r, c + reach), (r, c - reach)):
                if 0 <= i < h and 0 <= j < w and known[i, j]:
                    dot = 0.0
                    for k in range(3):
                        dot += normal[r, c, k] * normal[i, j, k]
                    bend += 1.0 - dot
                else:
                    bend += LONE_BEND
            level = 12.0 * np.sqrt(max(25.0 * bend, 0.0)) + 4.0 * max(rms[r, c] - 1.0, 0.0)
            levels[r, c] = np.uint8(min(LEVELS - 1.0, level))
    return levels
