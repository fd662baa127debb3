"""Levels of the segments and of the loops of a digit grid, computed from the ink."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.status.digit_grid import AXES, DigitGrid
from perception.vision.status.digit_grid_worth import BEYOND, INNER, STROKE, Float32

PARTS = 5  # samples along a segment's axis
CLEAR = 0.6  # visibility of a pixel that counts as visible
WHOLLY_SEEN = 0.5  # least visible share over all segments of a cell that counts as wholly visible
FRAME_LEVEL = 0.5  # share of an upright's level: ink above and below it that exceeds this makes it a frame's side
LEAST_LOOP_PLACES = 6
LOOP_X = np.linspace(0.36, 0.64, 3)
LOOP_Y = np.array([0.2, 0.25, 0.3, 0.7, 0.75, 0.8])


def segment_levels(ink: Float32, seen: Float32, grid: DigitGrid) -> tuple[Array, Array]:
    """Return level and visible share (cells, 7) of every segment.

    The level is the median along the segment's axis of the maximum across its stroke.
    """
    return _segments(ink, seen, grid.numbers, grid.count, AXES)


def loop_levels(ink: Float32, seen: Float32, grid: DigitGrid) -> tuple[Array, Array]:
    """Return mean and standard deviation (cells,) of the ink inside the loops of every cell; NaN if hidden.

    There is no segment inside a loop.
    """
    return _loops(ink, seen, grid.numbers, grid.count, LOOP_X, LOOP_Y)


def without_frames(ink: Float32, grid: DigitGrid, levels: Array) -> Array:
    """Return the levels (cells, 7) without uprights that continue above and below the digit, as a frame's sides do."""
    beyond = _beyond(ink, grid.numbers, grid.count)
    out = levels.copy()
    for side, (upper, lower) in enumerate(((5, 4), (1, 2))):
        drop = beyond[:, side] > FRAME_LEVEL * np.maximum(levels[:, upper], levels[:, lower])
        out[:, [upper, lower]] = np.where(drop[:, None], 0.0, out[:, [upper, lower]])
    return out


def with_hidden_ends(seen: Float32, grid: DigitGrid, most: int) -> DigitGrid:
    """Extend the grid by partly hidden cells at its ends.

    A digit that a cable crosses matches no character and gets no cell; without it the number would be a different one.

    Args:
        seen: (H, W) 1 where the display is visible.
        most: maximum number of cells.
    """
    for step_px in (grid.pitch_px, -grid.pitch_px):
        while grid.count < most:
            beyond = grid.count * grid.pitch_px if step_px > 0 else step_px
            end = replace(grid, left_px=grid.left_px + beyond, count=1)
            if not _fits(end, seen.shape[1]):
                break
            _, shares = segment_levels(seen, seen, end)
            if shares.min() >= WHOLLY_SEEN:
                break
            grid = replace(grid, left_px=grid.left_px + min(step_px, 0.0), count=grid.count + 1)
    return grid


def _fits(cell: DigitGrid, columns: int) -> bool:
    """Return whether a further cell with its strokes lies inside the picture."""
    u, _ = cell.place(np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0]), np.zeros(4))
    half = STROKE * cell.height_px
    return bool(u.min() >= half and u.max() <= columns - 1 - half)


@inlined
def _value(image: Float32, u: float, v: float) -> float:
    """Return the bilinear value at (u, v); 0 outside, with a linear transition over one pixel at the border."""
    height, width = image.shape
    if u <= -1.0 or v <= -1.0 or u >= width or v >= height:
        return 0.0
    x, y = int(np.floor(u)), int(np.floor(v))
    a, b = u - x, v - y
    value = 0.0
    for j in range(2):
        for i in range(2):
            if 0 <= x + i < width and 0 <= y + j < height:
                value += image[y + j, x + i] * (a if i else 1 - a) * (b if j else 1 - b)
    return value


@compiled
def _segments(ink: Float32, seen: Float32, grid: Array, count: int, axes: Array) -> tuple[Array, Array]:
    """Compute `segment_levels`; `axes` are the ends of the segments' axes in a cell."""
    left, pitch, width, top, bottom, slant = grid
    height = bottom - top
    levels, shares = np.zeros((count, 7)), np.zeros((count, 7))
    best = np.zeros(PARTS)
    for cell in range(count):
        for k in range(7):
            flat = axes[k, 0, 1] == axes[k, 1, 1]
            n = 0
            for i in range(PARTS):
                t = INNER + (1 - 2 * INNER) * i / (PARTS - 1)
                x = axes[k, 0, 0] + t * (axes[k, 1, 0] - axes[k, 0, 0])
                v = top + (axes[k, 0, 1] + t * (axes[k, 1, 1] - axes[k, 0, 1])) * height
                u = left + cell * pitch + x * width + slant * ((top + bottom) / 2 - v)
                strongest, clear, axis_clear = -1.0, 0, False
                for j in range(-1, 2):
                    across = j * 0.8 * STROKE * height
                    du, dv = (0.0, across) if flat else (across, 0.0)
                    if _value(seen, u + du, v + dv) > CLEAR:
                        clear += 1
                        axis_clear = axis_clear or j == 0
                        strongest = max(strongest, _value(ink, u + du, v + dv))
                # The outer sample alone proves nothing, because the stroke may be narrower
                if axis_clear and clear >= 2:
                    best[n] = strongest
                    n += 1
            levels[cell, k] = np.median(best[:n]) if n else 0.0
            shares[cell, k] = n / PARTS
    return levels, shares


@compiled
def _loops(ink: Float32, seen: Float32, grid: Array, count: int, xs: Array, ys: Array) -> tuple[Array, Array]:
    """Compute `loop_levels` from samples at the places `xs` x `ys` in a cell."""
    left, pitch, width, top, bottom, slant = grid
    means, spreads = np.full(count, np.nan), np.full(count, np.nan)
    for cell in range(count):
        n = 0
        total = squares = 0.0
        for y in ys:
            v = top + y * (bottom - top)
            for x in xs:
                u = left + cell * pitch + x * width + slant * ((top + bottom) / 2 - v)
                if _value(seen, u, v) > CLEAR:
                    value = _value(ink, u, v)
                    n += 1
                    total += value
                    squares += value * value
        if n >= LEAST_LOOP_PLACES:
            means[cell] = total / n
            spreads[cell] = np.sqrt(max(squares / n - (total / n) ** 2, 0.0))
    return means, spreads


@compiled
def _beyond(ink: Float32, grid: Array, count: int) -> Array:
    """Return the least ink (cells, 2) over the places above and below the left and right uprights.

    Each place counts with the maximum across the stroke.
    """
    left, pitch, width, top, bottom, slant = grid
    height = bottom - top
    found = np.zeros((count, 2))
    for cell in range(count):
        for side in range(2):
            least = np.inf
            for y in (-BEYOND[1], -BEYOND[0], 1.0 + BEYOND[0], 1.0 + BEYOND[1]):
                v = top + y * height
                u = left + cell * pitch + side * width + slant * ((top + bottom) / 2 - v)
                strongest = 0.0
                for across in range(-2, 3):
                    strongest = max(strongest, _value(ink, u + 0.8 * STROKE * height * across, v))
                least = min(least, strongest)
            found[cell, side] = least
    return found
