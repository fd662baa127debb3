"""Compiled sums for the grid search: the worth of seven-segment cells along rows of places and in one grid.

A cell's worth is the ink energy that its best character explains by segments of one level, minus the weighted residual:
P - k (T - P) with T = sum(area * level^2) over segments and loops, P = (sum of area * level over the lit ones)^2 /
their area, the projection on the character's flat template. A cell that straddles two digits or holds noise is worth
nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined

Float32 = NDArray[np.float32]

LEFT_OVER = 0.7  # k: weight of unexplained ink
STROKE = 0.05  # half of a stroke's width, in digit heights
INNER = 0.22  # share of an axis that is skipped at either end, because other segments meet it there
LOOP = 0.2  # half size of the probed middle of a loop, as a share of the cell's width and of half its height
FREE_GAP = 0.13
LEAST_GAP = 0.08  # between neighbours' uprights, in digit heights: below this they would be one shared upright
COARSE = 15.0  # height of a digit in the coarse search, in places
LEAST_WEIGHT = 0.15  # visible share of a segment below which it is ignored
MOST_CELLS = 64
NEGLIGIBLE = 0.02  # of the best cell's worth
BEYOND = (0.14, 0.34)  # in digit heights, above and below the digit: an upright that continues there belongs to a frame

#: Middle of every segment's axis in a cell of unit width and height, y down; the first row is x, the second y.
MIDDLES = np.array([[0.5, 1.0, 1.0, 0.5, 0.0, 0.0, 0.5], [0.0, 0.25, 0.75, 1.0, 0.75, 0.25, 0.5]])
FLAT = np.array([True, False, False, True, False, False, True])


@inlined
def cell_worth(levels: Array, areas: Array, loops: float, lit: Array) -> float:
    """Return the worth of one cell.

    Args:
        levels, areas: (7,) mean level and visible area of the segments.
        loops: energy in the cell's loops.
        lit: (characters, 7) 1 if a segment is lit.
    """
    total = loops
    for s in range(7):
        total += areas[s] * levels[s] * levels[s]
    square, over = 0.0, 1.0  # P of the best character is square / over; comparing products avoids slow divisions
    for g in range(lit.shape[0]):
        area = product = 0.0
        for s in range(7):
            seen = lit[g, s] * areas[s]
            area += seen
            product += seen * levels[s]
        if product * product * over > square * area:
            square, over = product * product, area
    best = square / over
    return max(0.0, best - LEFT_OVER * (total - best))


@compiled
def cell_boxes(top: float, height: float, width: float) -> Array:
    """Return the boxes (13, 4; left, top, right, bottom) of a cell whose left upright is at column 0.

    They are those of its seven segments, its two loops, and the areas above and below the left and the right uprights.
    """
    boxes = np.empty((13, 4))
    s, half = STROKE * height, height / 2
    for k in range(7):
        x, y = MIDDLES[0, k] * width + 0.5, top + MIDDLES[1, k] * height + 0.5
        dx, dy = ((0.5 - INNER) * width, s) if FLAT[k] else (s, (0.5 - INNER) * half)
        boxes[k] = np.array([x - dx, y - dy, x + dx, y + dy])
    for k in range(2):
        x, y = 0.5 * width + 0.5, top + (0.25 + 0.5 * k) * height + 0.5
        boxes[7 + k] = np.array([x - LOOP * width, y - LOOP * half, x + LOOP * width, y + LOOP * half])
        x, y = k * width + 0.5, top + 0.5
        boxes[9 + 2 * k] = np.array([x - 1.5 * s, y - BEYOND[1] * height, x + 1.5 * s, y - BEYOND[0] * height])
        y += height
        boxes[10 + 2 * k] = np.array([x - 1.5 * s, y + BEYOND[0] * height, x + 1.5 * s, y + BEYOND[1] * height])
    return boxes


@inlined
def _at_most(value: float, most: int) -> int:
    """Return the nearest integer, clipped to 0 .. `most`."""
    return max(0, min(most, int(value + 0.5)))


@compiled
def worth_along(
    ink: Array, seen: Array, whole: bool, place: tuple[float, float, float], stride: int, lit: Array, out: Array
) -> None:
    """Compute the worth of upright cells whose left upright is at column 0, `stride`, ... into `out`.

    Args:
        ink, seen: integral images.
        whole: whether nothing is hidden, so that areas need not be looked up.
        place: row of the top segment's axis, height from there to the bottom's, width between the uprights' axes, px.
    """
    rows, columns = ink.shape[0] - 1, ink.shape[1] - 1
    boxes = cell_boxes(place[0], place[1], place[2])
    # Cumulative over the columns, for the rows of each box
    energy, clear = np.empty((13, columns + 1)), np.empty((13, columns + 1))
    for b in range(13):
        top, bottom = _at_most(boxes[b, 1], rows), _at_most(boxes[b, 3], rows)
        for x in range(columns + 1):
            energy[b, x] = ink[bottom, x] - ink[top, x]
            clear[b, x] = (bottom - top) * x if whole else seen[bottom, x] - seen[top, x]
    lefts, rights = np.empty(13, np.int64), np.empty(13, np.int64)
    for b in range(13):
        lefts[b], rights[b] = int(np.floor(boxes[b, 0] + 0.5)), int(np.floor(boxes[b, 2] + 0.5))
    levels, areas = np.zeros(13), np.zeros(13)
    most = 0.0
    for k in range(len(out)):
        for b in range(13):
            left, right = max(0, min(columns, k * stride + lefts[b])), max(0, min(columns, k * stride + rights[b]))
            area = clear[b, right] - clear[b, left]
            areas[b] = area if area >= 1.0 else 0.0
            levels[b] = (energy[b, right] - energy[b, left]) / area if area >= 1.0 else 0.0
        segments = 0.0
        for b in range(7):
            segments += areas[b] * levels[b] * levels[b]
        if segments < NEGLIGIBLE * most:  # an upper bound of the worth is already negligible
            out[k] = 0.0
            continue
        rest = areas[7] * levels[7] * levels[7] + areas[8] * levels[8] * levels[8]
        for b in (9, 11):  # subtract the frame's share, at most the upright's own worth
            rest += 2.0 * areas[1] * min(levels[b], levels[b + 1]) ** 2 / LEFT_OVER
        out[k] = cell_worth(levels, areas, rest, lit)
        most = max(most, out[k])


@inlined
def apartness(gap: float) -> float:
    """Return the factor on a grid's worth for its gap (in digit heights).

    Neighbouring cells that nearly share their uprights would count the same ink twice.
    """
    return min(1.0, max(0.3, 0.3 + 0.7 * (gap - LEAST_GAP) / (FREE_GAP - LEAST_GAP)))


@compiled
def best_pitch(
    worth: Array, stride: int, pitches: Array, size: tuple[float, float], columns: int, most: int, free: float
) -> tuple[float, float, float, int]:
    """Return (worth, left column, pitch, cells) of the best grid of at most `most` cells.

    Args:
        worth: worth of cells at places `stride` px apart.
        pitches: candidates, in cell widths.
        size: width and height of a cell, px.
        free: largest distance of the grid's middle from the middle column, as a share of `columns`; distance lowers the
            worth.
    """
    width, height = size
    best, left, pitch, count = 0.0, 0.0, 0.0, 0
    cells = np.zeros(MOST_CELLS)
    per_stride = 1.0 / stride
    for ratio in pitches:
        p = ratio * width
        if p - width < LEAST_GAP * height:
            continue
        room = apartness((p - width) / height)
        phase = -0.1 * width
        while phase < p - 0.1 * width:
            n = 0
            u = phase
            while u + width < columns + 0.1 * width and n < MOST_CELLS:
                cells[n] = worth[max(0, min(len(worth) - 1, int(u * per_stride + 0.5)))]
                n += 1
                u += p
            for first in range(n):
                if cells[first] <= 0.0:
                    continue
                total = 0.0
                for last in range(first, min(n, first + most)):
                    total += cells[last]
                    if cells[last] <= 0.0:
                        continue
                    off = abs(phase + (first + last) / 2 * p + width / 2 - columns / 2) / max(free * columns, 1.0)
                    score = total * room * (1.0 - 0.15 * min(off, 1.0))
                    if off <= 1.0 and score > best:
                        best, left, pitch, count = score, phase + first * p, p, last - first + 1
            phase += stride
    return best, left, pitch, count


@compiled
def guesses(
    ink: Array, seen: Array, whole: bool, rows: Array, widths: Array, pitches: Array, most: int, free: float, lit: Array
) -> Array:
    """Return the best grid for every pair of rows and every width: (rows x widths, 7).

    The columns are worth, left, pitch, width, top, height and number of cells.

    Args:
        ink, seen: integral images of the upright picture.
        rows: (R, 2) top and height, px.
        widths: in digit heights.
        pitches: in cell widths.
    """
    found = np.zeros((len(rows) * len(widths), 7))
    columns = ink.shape[1] - 1
    for r in range(len(rows)):
        top, height = rows[r]
        stride = max(1, int(height / COARSE))
        worth = np.empty((columns + stride - 1) // stride)
        for w in range(len(widths)):
            width = widths[w] * height
            worth_along(ink, seen, whole, (top, height, width), stride, lit, worth)
            score, left, pitch, count = best_pitch(worth, stride, pitches, (width, height), columns, most, free)
            found[r * len(widths) + w] = np.array([score, left, pitch, width, top, height, float(count)])
    return found


@compiled
def slant_energies(uprights: Float32, slants: Array) -> Array:
    """Return for every slant the sum of squared column sums of the picture sheared by it, (slants,).

    It is largest if the uprights are vertical. Only every second row is used.
    """
    rows, columns = uprights.shape
    middle = (rows - 1) / 2
    energies = np.zeros(len(slants))
    for k in range(len(slants)):
        sums = np.zeros(columns + 2 * rows)
        for y in range(0, rows, 2):
            shift = rows + slants[k] * (y - middle)
            whole = int(shift)
            part = shift - whole
            for x in range(columns):
                value = uprights[y, x]
                sums[x + whole] += value * (1.0 - part)
                sums[x + whole + 1] += value * part
        energies[k] = (sums * sums).sum()
    return energies


def row_scores(profile: Array, heights: Array, step: float) -> Array:
    """Return score, top and height (N, 3) of digits: much flat ink in the segments' rows and little between them."""
    rows, found = len(profile), []
    for height in heights:
        tops = np.arange(0.02 * rows, 0.98 * rows - height, step)
        at = np.interp(tops + 0.25 * height * np.arange(5)[:, None], np.arange(rows), profile)
        scores = at[::2].sum(axis=0) + 2.0 * at[::2].min(axis=0) - 1.2 * (at[1] + at[3])
        found.append(np.column_stack([scores, tops, np.full(len(tops), height)]))
    return np.concatenate(found)
