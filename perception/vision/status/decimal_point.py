"""Search for the decimal point: ink that remains at the foot of a gap after the lit segments have been subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from hal.arrays import Array
from hal.jit import compiled
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
HALF_STROKES = np.array([0.045, 0.065])  # candidate half stroke widths, in digit heights; each is tried with every blur
BLURS = np.array([0.02, 0.05, 0.09])
INSETS = (0.2, 0.08, 0.32)  # shares of a segment's axis by which its stroke is shorter at either end
PLACES_X = np.linspace(0.25, 0.75, 6)  # candidate places across the gap, as shares of it
# Candidate places in a partly hidden gap: no stroke beside it confirms where the grid lies
MORE_PLACES_X = np.linspace(0.25, 1.05, 9)
PLACES_Y = np.linspace(-0.12, 0.06, 7)  # in digit heights, from the bottom segments' axis
COLON_STRIP, COLON_LEVEL = (
    (0.0, 1.0),
    0.8,
)  # colons of 36 synthetic clocks have 1.1 or more, gaps of 75 certain numbers up to 0.6
COLON_Y = (np.linspace(-0.80, -0.58, 7), np.linspace(-0.42, -0.20, 7))
LEAST_OF_DOT = 0.4  # visible share of a dot's template that is needed to estimate its height
STEPS = 8  # samples per px of the tabulated stroke profiles


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
    ink: Float32,
    seen: Float32,
    grid: DigitGrid,
    lit_levels: Array,
    *,
    strip: tuple[float, float] = STRIP,
    places_y: Array = PLACES_Y,
) -> tuple[Array, NDArray[np.bool_]]:
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
    drawn, sigma_px = _drawn(shown, clear, grid, lit_levels, first)
    rest = (shown - drawn) * clear
    dot = _dot(RADIUS * grid.height_px, sigma_px)
    levels, visible = _best_dots(rest, clear, dot, grid.numbers, grid.count, first, PLACES_X, places_y)
    if not visible.all():
        wide, _ = _best_dots(rest, clear, dot, grid.numbers, grid.count, first, MORE_PLACES_X, places_y)
        levels = np.where(visible > 0, levels, wide)
    gain = float(np.percentile(drawn, 99.0)) / max(float(lit_levels.max()), 1e-6)
    return levels / np.maximum(gain * _beside(lit_levels), 1e-6), visible > 0


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


def _drawn(strip: Float32, clear: Float32, grid: DigitGrid, lit_levels: Array, first: int) -> tuple[Float32, float]:
    """Draw the lit segments with the stroke width and blur that minimise the residual.

    Returns picture and blur in px.
    """
    h = grid.height_px
    shapes = [(half * h, max(blur * h, 0.3)) for half in HALF_STROKES for blur in BLURS]
    distance = np.arange(0.0, (HALF_STROKES[-1] + 2.5 * BLURS[-1]) * h + 1.0, 1.0 / STEPS)
    tables = np.stack([_profile(distance, half, blur) for half, blur in shapes], axis=1).astype(np.float32)
    where = (first, *strip.shape), grid.numbers, np.ascontiguousarray(lit_levels, float), AXES
    k, drawn, left = _closest(_strokes(*where, INSETS[0], tables), strip, clear)
    for inset in INSETS[1:]:
        _, other, other_left = _closest(_strokes(*where, inset, tables[:, k : k + 1].copy()), strip, clear)
        if other_left < left:
            drawn, left = other, other_left
    return drawn, shapes[k][1]


def _closest(canvases: Float32, strip: Float32, clear: Float32) -> tuple[int, Float32, float]:
    """Return the index of the picture (rows, columns, shapes) that fits the strip best.

    Also returns that picture scaled to fit, and the residual.
    """
    seen = (canvases * clear[..., None]).reshape(strip.size, -1)
    along = strip.ravel() @ seen
    square = np.maximum(np.einsum("pk,pk->k", seen, seen), 1e-6)
    k = int((along * along / square).argmax())
    drawn = np.asarray(seen[:, k] * (along[k] / square[k]), np.float32).reshape(strip.shape)
    return k, drawn, float((strip * strip * clear).sum() - along[k] * along[k] / square[k])


def _profile(distance: Array, half_px: float, sigma_px: float) -> Array:
    """Return the profile of a blurred stroke of unit height at distances from its axis."""
    scale = np.sqrt(2.0) * sigma_px
    return np.asarray(0.5 * (erf((half_px - distance) / scale) + erf((half_px + distance) / scale)))


@compiled
def _strokes(
    strip: tuple[int, int, int], grid: Array, lit_levels: Array, axes: Array, inset: float, tables: Float32
) -> Float32:
    """Return the sum (rows, columns, shapes) of the lit segments' strokes on a strip that begins at row strip[0].

    Args:
        tables: (N, shapes) stroke profiles, sampled every 1 / STEPS px from the axis.
    """
    first, rows, columns = strip
    left, pitch, width, top, bottom, slant = grid
    height = bottom - top
    shapes, reach = tables.shape[1], (tables.shape[0] - 1) / STEPS
    canvases = np.zeros((rows, columns, shapes), np.float32)
    ends = np.empty((2, 2))
    for cell in range(lit_levels.shape[0]):
        for k in range(7):
            level = lit_levels[cell, k]
            if level <= 0.0:
                continue
            for e in range(2):
                share = inset if e == 0 else 1.0 - inset
                x = axes[k, 0, 0] + share * (axes[k, 1, 0] - axes[k, 0, 0])
                v = top + (axes[k, 0, 1] + share * (axes[k, 1, 1] - axes[k, 0, 1])) * height
                ends[e, 0], ends[e, 1] = left + cell * pitch + x * width + slant * ((top + bottom) / 2 - v), v - first
            along_u, along_v = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
            length = along_u * along_u + along_v * along_v
            for y in range(max(0, int(ends[:, 1].min() - reach)), min(rows, int(ends[:, 1].max() + reach) + 1)):
                for x in range(max(0, int(ends[:, 0].min() - reach)), min(columns, int(ends[:, 0].max() + reach) + 1)):
                    t = min(1.0, max(0.0, ((x - ends[0, 0]) * along_u + (y - ends[0, 1]) * along_v) / length))
                    du, dv = x - ends[0, 0] - t * along_u, y - ends[0, 1] - t * along_v
                    off = int(np.sqrt(du * du + dv * dv) * STEPS)
                    if off < tables.shape[0]:
                        for s in range(shapes):
                            canvases[y, x, s] += level * tables[off, s]
    return canvases


@compiled
def _best_dots(
    rest: Float32, seen: Float32, dot: Float32, grid: Array, count: int, first: int, xs: Array, ys: Array
) -> tuple[Array, Array]:
    """Return the least-squares height (count - 1,) of the best dot on a constant background in each gap.

    Also returns 1 for each gap that is visible.
    """
    left, pitch, width, top, bottom, slant = grid
    rows, columns = rest.shape
    half = dot.shape[0] // 2
    # Variance of a fully visible dot template: a place that shows much less of it cannot determine the dot's
    # height.
    least = LEAST_OF_DOT * ((dot * dot).sum() - dot.sum() ** 2 / dot.size)
    best, clear = np.full(count - 1, -np.inf), np.zeros(count - 1)
    for gap in range(count - 1):
        visible = 0
        for y in ys:
            for x in xs:
                v = bottom + y * (bottom - top)
                u = left + gap * pitch + width + x * (pitch - width) + slant * ((top + bottom) / 2 - v)
                i, j = round(v) - first, round(u)
                product = total = weights = inks = n = 0.0
                for a in range(max(0, i - half), min(rows, i + half + 1)):
                    for b in range(max(0, j - half), min(columns, j + half + 1)):
                        if seen[a, b] < 0.5:
                            continue
                        weight = dot[a - i + half, b - j + half]
                        product += weight * rest[a, b]
                        total += weight * weight
                        weights += weight
                        inks += rest[a, b]
                        n += 1.0
                if n > 1.0 and total - weights * weights / n > least:
                    best[gap] = max(best[gap], (product - weights * inks / n) / (total - weights * weights / n))
                if 0 <= i < rows and 0 <= j < columns and seen[i, j] > 0.5:
                    visible += 1
        if visible > 0.6 * len(xs) * len(ys):
            clear[gap] = 1.0
    return np.maximum(best, -1e6), clear
