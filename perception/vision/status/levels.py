"""Levels of the segments and of the loops of a digit grid, computed from the ink."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.arrays import Array
from perception.vision.patch import sample_at
from perception.vision.status.digit_grid import AXES, DigitGrid
from perception.vision.status.digit_grid_worth import BEYOND, FLAT, INNER, STROKE, Float32

ALONG = np.linspace(INNER, 1.0 - INNER, 5)[:, None, None]  # places along a segment's axis
ACROSS = (
    0.8 * STROKE * np.arange(-2.0, 3.0)
)  # places across an upright, in digit heights; across a segment those within
CLEAR = 0.6  # visibility of a pixel that counts as visible
WHOLLY_SEEN = 0.5  # least visible share over all segments of a cell that counts as wholly visible
FRAME_LEVEL = 0.5  # share of an upright's level: ink above and below it that exceeds this makes it a frame's side
LEAST_LOOP_PLACES = 6
LOOP_X, LOOP_Y = np.meshgrid(np.linspace(0.36, 0.64, 3), [0.2, 0.25, 0.3, 0.7, 0.75, 0.8])


def segment_levels(ink: Float32, seen: Float32, grid: DigitGrid) -> tuple[Array, Array]:
    """Return level and visible share (cells, 7) of every segment.

    The level is the median along the segment's axis of the maximum across its stroke.
    """
    x, y = np.moveaxis(AXES[:, 0] + ALONG * (AXES[:, 1] - AXES[:, 0]), 2, 0)[..., None]
    across = ACROSS[1:4] * grid.height_px
    u, v = _places(grid, x, y)  # cells, places, segments, 1
    u, v = np.broadcast_arrays(u + np.where(FLAT[:, None], 0.0, across), v + np.where(FLAT[:, None], across, 0.0))
    clear = _at(seen, u, v) > CLEAR
    strongest = np.where(clear, _at(ink, u, v), -1.0).max(axis=3)
    # The outer sample alone proves nothing, because the stroke may be narrower
    known = clear[..., 1] & (clear.sum(axis=3) >= 2)
    levels = np.nanmedian(np.where(known, strongest, np.where(known.any(axis=1, keepdims=True), np.nan, 0.0)), axis=1)
    return levels, known.mean(axis=1)


def loop_levels(ink: Float32, seen: Float32, grid: DigitGrid) -> tuple[Array, Array]:
    """Return mean and standard deviation (cells,) of the ink inside the loops of every cell; NaN if hidden.

    There is no segment inside a loop.
    """
    u, v = _places(grid, LOOP_X.ravel(), LOOP_Y.ravel())
    known = _at(seen, u, v) > CLEAR
    share = known / np.where((count := known.sum(axis=1, keepdims=True)) >= LEAST_LOOP_PLACES, count, np.nan)
    values = _at(ink, u, v)
    means = (share * values).sum(axis=1)
    return means, np.sqrt((share * (values - means[:, None]) ** 2).sum(axis=1))


def without_frames(ink: Float32, grid: DigitGrid, levels: Array) -> Array:
    """Return the levels (cells, 7) without uprights that continue above and below the digit, as a frame's sides do."""
    y = np.array([-BEYOND[1], -BEYOND[0], 1.0 + BEYOND[0], 1.0 + BEYOND[1]])[:, None]
    out = levels.copy()
    for x, uprights in ((0.0, (5, 4)), (1.0, (1, 2))):
        u, v = _places(grid, np.full_like(y, x), y)
        beyond = _at(ink, *np.broadcast_arrays(u + ACROSS * grid.height_px, v)).max(axis=2).min(axis=1)
        out[:, uprights] *= (beyond <= FRAME_LEVEL * levels[:, uprights].max(axis=1))[:, None]
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


def _places(grid: DigitGrid, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the pixel coordinates (cells, ...) of places in all cells of a grid."""
    u, v = grid.place(x, y, np.arange(float(grid.count)).reshape(-1, *[1] * x.ndim))
    return u, np.broadcast_to(v, u.shape)


def _at(image: Float32, u: Array, v: Array) -> Array:
    """Return the bilinear values at pixel coordinates of any common shape; 0 outside."""
    return np.asarray(sample_at(image, u.ravel(), v.ravel(), outside=0.0), float).reshape(u.shape)
