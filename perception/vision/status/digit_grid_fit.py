"""Compiled continuous refinement of a rough digit grid: its worth from box means, and the steps that increase it."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.status.digit_grid_worth import (
    FLAT,
    INNER,
    LEAST_GAP,
    LEAST_WEIGHT,
    LOOP,
    MIDDLES,
    STROKE,
    Float32,
    apartness,
    cell_worth,
)


@inlined
def _at(image: Float32, u: float, v: float) -> float:
    """Return the bilinear value at (u, v); 0 outside the image."""
    height, width = image.shape
    if u < 0.0 or v < 0.0 or u > width - 1 or v > height - 1:
        return 0.0
    x, y = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - x, v - y
    above = image[y, x] * (1 - a) + image[y, x + 1] * a
    return float(above * (1 - b) + (image[y + 1, x] * (1 - a) + image[y + 1, x + 1] * a) * b)


@compiled
def grid_worth(means: Float32, shares: Float32, whole: bool, grid: Array, count: int, lit: Array) -> float:
    """Return the worth of a grid (left, pitch, width, top, bottom, slant) of `count` cells.

    Args:
        means: (3, H, W) around every pixel: mean ink of a flat segment, of an upright one, and mean square in a loop.
        shares: (2, H, W) visible share of a flat and an upright segment around every pixel; ignored if `whole`.
    """
    left, pitch, width, top, bottom, slant = grid
    height = bottom - top
    long = (1 - 2 * INNER) * 2 * STROKE * height
    levels, areas = np.zeros(7), np.zeros(7)
    total = 0.0
    for cell in range(count):
        for k in range(7):
            kind = 0 if FLAT[k] else 1
            v = top + MIDDLES[1, k] * height
            u = left + cell * pitch + MIDDLES[0, k] * width + slant * ((top + bottom) / 2 - v)
            weight = 1.0 if whole else _at(shares[kind], u, v)
            levels[k] = _at(means[kind], u, v) / weight if weight > LEAST_WEIGHT else 0.0
            areas[k] = long * (width if kind == 0 else height / 2) * (weight if weight > LEAST_WEIGHT else 0.0)
        loops = 0.0
        for y in (0.25, 0.75):
            v = top + y * height
            loops += _at(means[2], left + cell * pitch + 0.5 * width + slant * ((top + bottom) / 2 - v), v)
        total += cell_worth(levels, areas, loops * 2 * LOOP * width * LOOP * height, lit)
    return total * (apartness((pitch - width) / height) if count > 1 else 1.0)


@compiled
def refine_grid(
    means: Float32, shares: Float32, whole: bool, grid: Array, count: int, lit: Array, steps: Array, lean: float
) -> float:
    """Refine a grid in place by coordinate search and return its worth.

    Args:
        means, shares, whole: as for `grid_worth`.
        grid: (6,) left, pitch, width, top, bottom, slant.
        steps: step sizes in digit heights, one round of search per step.
        lean: slant that has already been removed from the picture.
    """
    score = grid_worth(means, shares, whole, grid, count, lit)
    moves = np.array([
        [1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0], [-1.0, 1.0, 0, 0, 0, 0], [-0.5, 0, 1.0, 0, 0, 0],
        [0, 0, 0, 1.0, 0, 0], [0, 0, 0, 0, 1.0, 0], [0, 0, 0, 1.0, 1.0, 0], [0, 0, 0, 0, 0, 1.0],
    ])  # fmt: skip
    tried = np.empty(6)
    for step in steps:
        for _ in range(3):
            height = grid[4] - grid[3]
            chosen, best = grid.copy(), score
            for k in range(len(moves)):
                for sign in (-1.0, 1.0):
                    for i in range(6):
                        tried[i] = sign * step * moves[k, i] * (height if i < 5 else 1.0)
                    if moves[k, 1] != 0.0:
                        tried[1] /= max(1, count - 1)
                    tried += grid
                    if not is_sound(tried, count, means.shape[1], means.shape[2], lean):
                        continue
                    value = grid_worth(means, shares, whole, tried, count, lit)
                    if value > best:
                        chosen[:] = tried
                        best = value
            if best <= score:
                break
            grid[:] = chosen
            score = best
    return score


@inlined
def is_sound(grid: Array, count: int, rows: int, columns: int, lean: float) -> bool:
    """Return whether the cells of a grid are shaped like digits, stay in the picture and do not overlap.

    Overlapping neighbours would share an upright stroke.
    """
    left, pitch, width, top, bottom, slant = grid
    height = bottom - top
    right = left + (count - 1) * pitch + width
    return bool(
        height >= 6.0 and pitch - width >= LEAST_GAP * height and 0.33 * height <= width <= 0.72 * height
        and left >= -0.1 * width and right <= columns + 0.1 * width and top >= 0.0 and bottom <= rows - 1.0
        and -0.06 <= slant + lean <= 0.32
    )  # fmt: skip
