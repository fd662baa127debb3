"""Search for the decimal point: ink that remains at the foot of a gap after the lit segments have been subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.status.digit_grid import AXES, DigitGrid
from perception.vision.status.digit_grid_worth import Float32

RADIUS = 0.075  # of the digit height
# Level of a dot over that of a lit segment. Dots blurred by motion have 0.4 to 0.6, gaps without a dot up to 0.37
# (of 1400 synthetic ones).
LEVEL = 0.47
LEVEL_SPREAD = 0.07
MOST_TYPICAL = 0.37  # if gaps without a point exceed this, the stroke model is wrong
MOST_ODDS = 6.0  # log odds at most: a brighter dot is not more certain, and two gaps with a dot each stay ambiguous
HIDDEN_ODDS = -0.7  # log odds of a point in a hidden gap against no point at all
STRIP = (0.55, 1.25)  # rows that are searched, in digit heights from the digit's top
STROKES, BLURS = (0.09, 0.13), (0.02, 0.05, 0.09)  # candidate widths and blurs of a stroke, in digit heights
INSET = 0.2  # share of a segment's axis by which its stroke is shorter at either end
PLACES_X = np.linspace(0.25, 0.75, 6)  # candidate places across the gap, as shares of it
# Candidate places in a partly hidden gap: no stroke beside it confirms where the grid lies
MORE_PLACES_X = np.linspace(0.25, 1.05, 9)
PLACES_Y = np.linspace(-0.12, 0.06, 7)  # in digit heights, from the bottom segments' axis
# Colons of 36 synthetic clocks have 1.1 or more, gaps of 75 certain numbers up to 0.6.
COLON_STRIP, COLON_LEVEL = (0.0, 1.0), 0.8
COLON_Y = (np.linspace(-0.80, -0.58, 7), np.linspace(-0.42, -0.20, 7))
LEAST_OF_DOT = 0.4  # visible share of a dot's template that is needed to estimate its height
NOWHERE = -1e6  # height of a dot where too little of it is visible
FINER = 4  # how much larger than the picture strokes are drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class DecimalPoint:
    """Number of cells before the decimal point (None if there is none), and the probability that this is correct."""

    place: int | None
    probability: float


def find_decimal_point(ink: Float32, seen: Float32, grid: DigitGrid, lit_levels: Array) -> DecimalPoint:
    """Find the decimal point.

    A dot template must reach a share of a lit segment's level and stand out from the other gaps.

    Args:
        lit_levels: (cells, 7) levels of the lit segments, 0 for the others.
    """
    if grid.count < 2:
        return DecimalPoint(place=None, probability=1.0)
    levels, clear = dot_levels(ink, seen, grid, lit_levels)
    if not clear.any():
        return DecimalPoint(place=None, probability=0.5)
    order = np.sort(levels[clear])
    typical = float(np.clip(np.median(order[:-1]), 0.0, MOST_TYPICAL)) if len(order) > 1 else 0.0
    odds = (levels - typical - LEVEL) / LEVEL_SPREAD
    # A partly hidden gap can show a dot, but the absence of one proves nothing. The last entry means no point.
    odds = np.append(np.clip(odds, np.where(clear, -30.0, HIDDEN_ODDS), MOST_ODDS), 0.0)
    share = np.exp(odds - odds.max())
    k = int(share.argmax())
    return DecimalPoint(place=None if k == len(levels) else k + 1, probability=float(share[k] / share.sum()))


def find_colon(ink: Float32, seen: Float32, grid: DigitGrid, lit_levels: Array) -> int | None:
    """Return the number of cells before a clock's colon; None if there is none.

    A colon is one dot in the upper and one in the lower half of a gap.
    """
    if grid.count < 2:
        return None
    dots = [dot_levels(ink, seen, grid, lit_levels, strip=COLON_STRIP, places_y=ys)[0] for ys in COLON_Y]
    both = np.minimum(*dots)
    k = int(both.argmax())
    return k + 1 if both[k] > COLON_LEVEL else None


def dot_levels(
    ink: Float32, seen: Float32, grid: DigitGrid, lit_levels: Array, *, strip: tuple[float, float] = STRIP,
    places_y: Array = PLACES_Y,
) -> tuple[Array, NDArray[np.bool_]]:  # fmt: skip
    """Return the level (cells - 1,) of the best dot in every gap, relative to lit segments beside it.

    Also returns whether each gap is visible.

    Args:
        strip: rows that are searched, in digit heights from the digit's top.
        places_y: candidate heights of the dot, in digit heights from the bottom segments' axis.
    """
    first, last = (round(grid.top_px + share * grid.height_px) for share in strip)
    first, last = max(0, first), min(len(ink), last)
    if last - first < 3:
        return np.zeros(grid.count - 1), np.zeros(grid.count - 1, bool)
    shown, clear = ink[first:last], seen[first:last]
    drawn, sigma_px = _drawn(ink.shape, grid, lit_levels, shown, clear, slice(first, last))
    heights = _heights((shown - drawn) * clear, clear, _dot(RADIUS * grid.height_px, sigma_px))
    levels, visible = _best_dots(heights, clear, grid, first, PLACES_X, places_y)
    if not visible.all():
        wide, _ = _best_dots(heights, clear, grid, first, MORE_PLACES_X, places_y)
        levels = np.where(visible, levels, wide)
    gain = float(np.percentile(drawn, 99.0)) / max(float(lit_levels.max()), 1e-6)
    return levels / np.maximum(gain * _beside(lit_levels), 1e-6), visible


def _beside(lit_levels: Array) -> Array:
    """Return the level (cells - 1,) of lit segments beside every gap; behind glare a dot is as dim as they are."""
    lit = lit_levels > 0
    cells = np.where(lit.any(axis=1), (lit_levels * lit).sum(axis=1) / np.maximum(lit.sum(axis=1), 1), np.nan)
    if not np.isfinite(cells).any():
        return np.ones(len(cells) - 1)
    typical = float(np.median(cells[np.isfinite(cells)]))
    cells = np.where(np.isfinite(cells), cells, typical)
    return np.maximum(0.5 * (cells[:-1] + cells[1:]), 0.2 * typical)


def _dot(radius_px: float, sigma_px: float) -> Float32:
    """Return the template of a blurred disc, which has unit height before it is blurred."""
    half = int(np.ceil(radius_px + 2.5 * sigma_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = np.clip(radius_px + 0.5 - np.hypot(x, y), 0.0, 1.0).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(disc, (0, 0), max(sigma_px, 0.3), borderType=cv2.BORDER_CONSTANT), np.float32)


def _drawn(
    shape: tuple[int, ...], grid: DigitGrid, lit_levels: Array, shown: Float32, clear: Float32, rows: slice
) -> tuple[Float32, float]:
    """Draw the lit segments on some rows of a picture, with the stroke and the blur that fit the ink `shown` there best.

    Returns the drawing, scaled to fit where the ink is `clear`, and its blur in px.
    """
    most, best = -1.0, (np.zeros_like(shown), 0.3)
    for stroke in STROKES:
        sharp = _strokes(shape, grid, lit_levels, stroke)
        for blur in BLURS:
            sigma_px = max(blur * grid.height_px, 0.3)
            drawn = cv2.GaussianBlur(sharp, (0, 0), sigma_px)[rows] * clear
            along, square = float((drawn * shown).sum()), max(float((drawn * drawn).sum()), 1e-6)
            if along * along / square > most:
                most, best = along * along / square, (drawn * (along / square), sigma_px)
    return best


def _strokes(shape: tuple[int, ...], grid: DigitGrid, lit_levels: Array, stroke: float) -> Float32:
    """Return a picture (H, W) of the lit segments, without blur."""
    large = np.zeros((FINER * shape[0], FINER * shape[1]), np.float32)
    thick = max(1, round(FINER * stroke * grid.height_px))
    shares = np.array([[1.0 - INSET, INSET], [INSET, 1.0 - INSET]])
    for cell, segment in zip(*np.nonzero(lit_levels), strict=True):
        x, y = (shares @ AXES[segment]).T
        places = np.column_stack(grid.place(x, y, np.full(2, cell)))
        first, last = np.round(16 * (FINER * (places + 0.5) - 0.5)).astype(int).tolist()
        cv2.line(large, first, last, float(lit_levels[cell, segment]), thick, cv2.LINE_8, 4)
    return np.asarray(cv2.resize(large, shape[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _heights(rest: Float32, clear: Float32, dot: Float32) -> Array:
    """Return the least-squares height (H, W) of a dot on a constant background around every pixel."""

    def around(image: Float32, kernel: Float32) -> Array:
        return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT), float)

    flat = np.ones_like(dot)
    count = np.maximum(around(clear, flat), 1.0)
    weight = around(clear, dot)
    variance = around(clear, dot * dot) - weight**2 / count
    height = (around(rest, dot) - weight * around(rest, flat) / count) / np.maximum(variance, 1e-6)
    # A place that shows much less of the template's variance than a fully visible one cannot determine the height.
    least = LEAST_OF_DOT * float((dot * dot).sum() - dot.sum() ** 2 / dot.size)
    return np.where(variance > least, height, NOWHERE)


def _best_dots(
    heights: Array, clear: Float32, grid: DigitGrid, first: int, xs: Array, ys: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the height (cells - 1,) of the best dot at the places `xs` x `ys` in each gap, and which gaps are visible."""
    gaps = np.arange(grid.count - 1.0)[:, None, None]
    across = 1.0 + xs * (grid.pitch_px - grid.width_px) / grid.width_px
    u, v = np.broadcast_arrays(*grid.place(across, 1.0 + ys[:, None], gaps))
    i, j = np.rint(v).astype(int) - first, np.rint(u).astype(int)
    inside = (i >= 0) & (i < heights.shape[0]) & (j >= 0) & (j < heights.shape[1])
    i, j = i.clip(0, heights.shape[0] - 1), j.clip(0, heights.shape[1] - 1)
    best = np.where(inside, heights[i, j], NOWHERE).max(axis=(1, 2))
    return best, (inside & (clear[i, j] > 0.5)).mean(axis=(1, 2)) > 0.6
