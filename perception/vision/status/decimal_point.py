"""The decimal point: what is left at the foot of a gap between digits when the lit segments have been taken away."""

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
LEVEL = 0.47  # of a lit segment: dots blurred by motion have .4 to .6, gaps without one up to .37 (of 1400 drawn ones)
LEVEL_SPREAD = 0.07
MOST_TYPICAL = 0.37  # where the gaps without a point seem to have more, the strokes are not known
MOST_ODDS = 6.0  # logarithm: a dot that is brighter is no surer, and two gaps with one each stay in doubt
HIDDEN_ODDS = -0.7  # logarithm, of a point in a gap that is hidden against no point at all
STRIP = (0.55, 1.25)  # rows that are looked at, over the digit height from its top
HALF_STROKES = np.array([0.045, 0.065])  # of the digit height: tried, with every blur
BLURS = np.array([0.02, 0.05, 0.09])
INSETS = (0.2, 0.08, 0.32)  # of a segment's axis, at either end, by which its stroke is shorter
PLACES_X = np.linspace(0.25, 0.75, 6)  # of the gap
MORE_PLACES_X = np.linspace(0.25, 1.05, 9)  # of one hidden in part: no stroke beside it says where the grid lies
PLACES_Y = np.linspace(-0.12, 0.06, 7)  # of the digit height, from the bottom segments' axis
COLON_STRIP, COLON_LEVEL = (
    (0.0, 1.0),
    0.8,
)  # colons of 36 drawn clocks have 1.1 or more, gaps of 75 sure numbers up to .6
COLON_Y = (np.linspace(-0.80, -0.58, 7), np.linspace(-0.42, -0.20, 7))
LEAST_OF_DOT = 0.4  # of a dot's picture that must be seen to tell its height
STEPS = 8  # places a px at which a stroke's profile is tabled


@dataclass(frozen=True, slots=True, kw_only=True)
class DecimalPoint:
    """Number of cells before the decimal point (None without one), and the probability that this is so."""

    place: int | None
    probability: float


def find_decimal_point(ink: Float32, seen: Float32, grid: DigitGrid, lit_levels: Array) -> DecimalPoint:
    """Where the decimal point is.

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
    # A gap that is hidden in part may show a dot; that it shows none says nothing. The last: no point.
    odds = np.append(np.clip(odds, np.where(clear, -30.0, HIDDEN_ODDS), MOST_ODDS), 0.0)
    share = np.exp(odds - odds.max())
    k = int(share.argmax())
    return DecimalPoint(place=None if k == len(levels) else k + 1, probability=float(share[k] / share.sum()))


def find_colon(ink: Float32, seen: Float32, grid: DigitGrid, lit_levels: Array) -> int | None:
    """Number of cells before a clock's colon: a gap with one dot in its upper half and one in its lower; None without one."""
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
    """(cells - 1,) level of the best dot in every gap over that of lit segments beside it, and whether the gap is seen.

    Args:
        strip: rows that are looked at, over the digit height from its top.
        places_y: of the dot, over the digit height, from the bottom segments' axis.
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
    """(cells - 1,) level of lit segments beside every gap: behind glare a dot is dimmer, as its neighbours are."""
    lit = lit_levels > 0
    cells = np.where(lit.any(axis=1), (lit_levels * lit).sum(axis=1) / np.maximum(lit.sum(axis=1), 1), np.nan)
    if not np.isfinite(cells).any():
        return np.ones(len(cells) - 1)
    typical = float(np.median(cells[np.isfinite(cells)]))
    cells = np.where(np.isfinite(cells), cells, typical)
    return np.maximum(0.5 * (cells[:-1] + cells[1:]), 0.2 * typical)


def _dot(radius_px: float, sigma_px: float) -> Float32:
    """A blurred disc of unit height before the blur."""
    half = int(np.ceil(radius_px + 2.5 * sigma_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    disc = np.clip(radius_px + 0.5 - np.hypot(x, y), 0.0, 1.0).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(disc, (0, 0), max(sigma_px, 0.3), borderType=cv2.BORDER_CONSTANT), np.float32)


def _drawn(strip: Float32, clear: Float32, grid: DigitGrid, lit_levels: Array, first: int) -> tuple[Float32, float]:
    """The lit segments as drawn strokes with the width and blur that leave the least, and that blur in px."""
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
    """Which of (rows, columns, shapes) pictures fits the strip best, that picture at its best strength, what it leaves."""
    seen = (canvases * clear[..., None]).reshape(strip.size, -1)
    along = strip.ravel() @ seen
    square = np.maximum(np.einsum("pk,pk->k", seen, seen), 1e-6)
    k = int((along * along / square).argmax())
    drawn = np.asarray(seen[:, k] * (along[k] / square[k]), np.float32).reshape(strip.shape)
    return k, drawn, float((strip * strip * clear).sum() - along[k] * along[k] / square[k])


def _profile(distance: Array, half_px: float, sigma_px: float) -> Array:
    """Height of a blurred stroke of unit height at a distance from its axis."""
    scale = np.sqrt(2.0) * sigma_px
    return np.asarray(0.5 * (erf((half_px - distance) / scale) + erf((half_px + distance) / scale)))


@compiled
def _strokes(
    strip: tuple[int, int, int], grid: Array, lit_levels: Array, axes: Array, inset: float, tables: Float32
) -> Float32:
    """(rows, columns, shapes) sum of the lit segments' strokes on a strip that begins at row strip[0].

    Args:
        tables: (N, shapes) height of a stroke at every 1 / STEPS px from its axis.
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
    """(count - 1,) least-squares height of the best dot over an even ground in every gap, and 1 where the gap is seen."""
    left, pitch, width, top, bottom, slant = grid
    rows, columns = rest.shape
    half = dot.shape[0] // 2
    # What a dot's picture varies by, seen whole: a place that shows less of one cannot tell its height.
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
