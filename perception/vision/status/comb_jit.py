"""Compiled parts of the comb search: how well a cell's segments make a character, along rows of places and in one comb.

A cell's worth is the ink energy that its best character explains by segments of one level, less what it leaves:
P - k (T - P) with T = sum(area * level^2) over segments and loops, P = (sum of area * level over the lit ones)^2 / their
area, the projection on the character's flat template. Straddling two digits or holding noise is worth nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.vision.view import Array

Float32 = NDArray[np.float32]

LEFT_OVER = 0.7  # k: what unexplained ink costs
STROKE = 0.05  # half of a stroke's width over the digit height
INNER = 0.22  # of an axis, left out at either end: there other segments meet it
LOOP = 0.2  # half size of the probed middle of a loop, over the cell's width; half of that over its height
PARTS = 5
FREE_GAP = 0.13
LEAST_GAP = 0.08  # between neighbours' uprights over the digit height: closer ones would be one upright shared


@njit(cache=True)
def cell_worth(levels: Array, areas: Array, loops: float, lit: NDArray[np.bool_]) -> float:  # pragma: no cover
    """Worth of one cell: (7,) levels and seen areas, energy in its loops, (characters, 7) which segments are lit."""
    total = loops
    for s in range(7):
        total += areas[s] * levels[s] * levels[s]
    best = 0.0
    for g in range(lit.shape[0]):
        area = product = 0.0
        for s in range(7):
            if lit[g, s]:
                area += areas[s]
                product += areas[s] * levels[s]
        if area > 0.0:
            explained = product * product / area
            best = max(best, explained - LEFT_OVER * (total - explained))
    return best


@njit(cache=True)
def _mean(
    ink: Array, seen: Array, x0: float, y0: float, x1: float, y1: float
) -> tuple[float, float]:  # pragma: no cover
    """(mean ink of what is seen, seen area) of a box, by integral images."""
    height, width = ink.shape[0] - 1, ink.shape[1] - 1
    left, right = max(0, min(width, round(x0))), max(0, min(width, round(x1)))
    top, bottom = max(0, min(height, round(y0))), max(0, min(height, round(y1)))
    if right <= left or bottom <= top:
        return 0.0, 0.0
    area = seen[bottom, right] - seen[top, right] - seen[bottom, left] + seen[top, left]
    if area < 1.0:
        return 0.0, 0.0
    return (ink[bottom, right] - ink[top, right] - ink[bottom, left] + ink[top, left]) / area, area


@njit(cache=True)
def worth_along(
    ink: Array, seen: Array, top: float, height: float, width: float, lit: NDArray[np.bool_], out: Array
) -> None:  # pragma: no cover
    """Worth of upright cells whose left upright stands at column 0, 1, ... of integral images `ink` and `seen`.

    Args:
        top: row of the top segment's axis; height: from there to the bottom's; width: between the uprights' axes, px.
        out: (W,) filled.
    """
    s = STROKE * height
    levels, areas = np.zeros(7), np.zeros(7)
    half = height / 2
    for x in range(len(out)):
        x0, x1 = x + INNER * width + 0.5, x + (1 - INNER) * width + 0.5
        for k, y in ((0, 0.0), (6, 0.5), (3, 1.0)):
            v = top + y * height + 0.5
            levels[k], areas[k] = _mean(ink, seen, x0, v - s, x1, v + s)
        for k, dx, dy in ((5, 0.0, 0.0), (1, width, 0.0), (4, 0.0, half), (2, width, half)):
            v = top + dy + 0.5
            u = x + dx + 0.5
            levels[k], areas[k] = _mean(ink, seen, u - s, v + INNER * half, u + s, v + (1 - INNER) * half)
        loops = 0.0
        for y in (0.25, 0.75):
            u, v = x + 0.5 * width + 0.5, top + y * height + 0.5
            level, area = _mean(ink, seen, u - LOOP * width, v - LOOP * half, u + LOOP * width, v + LOOP * half)
            loops += area * level * level
        out[x] = cell_worth(levels, areas, loops, lit)


@njit(cache=True)
def apartness(gap: float) -> float:  # pragma: no cover
    """What a comb's worth is multiplied by for its gaps (over the digit height): neighbours that all but share their
    uprights count the same ink twice."""
    return min(1.0, max(0.3, 0.3 + 0.7 * (gap - LEAST_GAP) / (FREE_GAP - LEAST_GAP)))


@njit(cache=True)
def best_pitch(
    worth: Array, pitches: Array, width: float, height: float, most: int, free: float
) -> tuple[float, float, float, int]:  # pragma: no cover
    """(worth, left column, pitch, cells) of the best comb of at most `most` cells over (W,) worths of cells.

    Args:
        free: how far the comb's middle may lie from the middle column; combs off the middle count down to half.
    """
    size = len(worth)
    best, left, pitch, count = 0.0, 0.0, 0.0, 0
    cells = np.zeros(64)
    for p in pitches:
        room = apartness((p - width) / height)
        phase = -0.1 * width
        while phase < p - 0.1 * width:
            n = 0
            u = phase
            while u + width < size + 0.1 * width and n < 64:
                k = max(0, min(size - 1, round(u)))
                cells[n] = worth[k]
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
                    off = abs(phase + (first + last) / 2 * p + width / 2 - size / 2) / max(free * size, 1.0)
                    score = total * room * (1.0 - 0.15 * min(off, 1.0))
                    if off <= 1.0 and score > best:
                        best, left, pitch, count = score, phase + first * p, p, last - first + 1
            phase += 1.0
    return best, left, pitch, count


@njit(cache=True)
def _at(image: Float32, u: float, v: float) -> float:  # pragma: no cover
    """Bilinear value, 0 outside."""
    height, width = image.shape
    if u < 0.0 or v < 0.0 or u > width - 1 or v > height - 1:
        return 0.0
    x, y = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - x, v - y
    above = image[y, x] * (1 - a) + image[y, x + 1] * a
    return float(above * (1 - b) + (image[y + 1, x] * (1 - a) + image[y + 1, x + 1] * a) * b)


@njit(cache=True)
def comb_worth(
    ink: Float32, seen: Float32, comb: Array, count: int, axes: Array, lit: NDArray[np.bool_]
) -> float:  # pragma: no cover
    """Worth of a comb (left, pitch, width, top, bottom, slant) of `count` cells; `ink` is 0 where `seen` is 0."""
    left, pitch, width, top, bottom, slant = comb
    height = bottom - top
    s = 0.8 * STROKE * height
    levels, areas = np.zeros(7), np.zeros(7)
    total = 0.0
    for cell in range(count):
        for k in range(7):
            flat = axes[k, 0, 1] == axes[k, 1, 1]
            whole = (1 - 2 * INNER) * 2 * STROKE * height * (width if flat else height / 2)
            value = weight = 0.0
            for i in range(PARTS):
                share = INNER + (1 - 2 * INNER) * i / (PARTS - 1)
                x = axes[k, 0, 0] + share * (axes[k, 1, 0] - axes[k, 0, 0])
                v = top + (axes[k, 0, 1] + share * (axes[k, 1, 1] - axes[k, 0, 1])) * height
                u = left + cell * pitch + x * width + slant * ((top + bottom) / 2 - v)
                for j in range(-1, 2):
                    du, dv = (0.0, j * s) if flat else (j * s, 0.0)
                    value += _at(ink, u + du, v + dv)
                    weight += _at(seen, u + du, v + dv)
            levels[k] = value / weight if weight > 0.5 else 0.0
            areas[k] = whole * weight / (3 * PARTS)
        loops = 0.0
        for y in (0.25, 0.75):
            v = top + y * height
            u = left + cell * pitch + 0.5 * width + slant * ((top + bottom) / 2 - v)
            for i in range(-1, 2):
                for j in range(-1, 2):
                    loops += _at(ink, u + i * LOOP * width * 0.7, v + j * LOOP * height / 2 * 0.7) ** 2 / 9
        total += cell_worth(levels, areas, loops * 2 * LOOP * width * LOOP * height, lit)
    return total * (apartness((pitch - width) / height) if count > 1 else 1.0)


@njit(cache=True)
def refine_comb(
    ink: Float32, seen: Float32, comb: Array, count: int, axes: Array, lit: NDArray[np.bool_], steps: Array
) -> float:  # pragma: no cover
    """Coordinate search around a comb, which is changed in place; its worth.

    Args:
        comb: (6,) left, pitch, width, top, bottom, slant.
        steps: search steps over the digit height, one round each.
    """
    score = comb_worth(ink, seen, comb, count, axes, lit)
    moves = np.array([
        [1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0], [-1.0, 1.0, 0, 0, 0, 0], [-0.5, 0, 1.0, 0, 0, 0],
        [0, 0, 0, 1.0, 0, 0], [0, 0, 0, 0, 1.0, 0], [0, 0, 0, 1.0, 1.0, 0], [0, 0, 0, 0, 0, 1.0],
    ])  # fmt: skip
    for step in steps:
        for _ in range(3):
            height = comb[4] - comb[3]
            chosen, best = comb, score
            for k in range(len(moves)):
                for sign in (-1.0, 1.0):
                    change = sign * step * moves[k]
                    change[:5] *= height
                    if moves[k, 1] != 0.0:
                        change[1] /= max(1, count - 1)
                    tried = comb + change
                    if not is_sound(tried, count, ink.shape[0], ink.shape[1]):
                        continue
                    value = comb_worth(ink, seen, tried, count, axes, lit)
                    if value > best:
                        chosen, best = tried, value
            if best <= score:
                break
            comb[:] = chosen
            score = best
    return score


@njit(cache=True)
def is_sound(comb: Array, count: int, rows: int, columns: int) -> bool:  # pragma: no cover
    """Whether cells keep apart (else neighbours would share an upright), stay in the picture and look like digits."""
    left, pitch, width, top, bottom, slant = comb
    height = bottom - top
    right = left + (count - 1) * pitch + width
    return bool(
        height >= 6.0 and pitch - width >= LEAST_GAP * height and 0.33 * height <= width <= 0.72 * height
        and left >= -0.1 * width and right <= columns + 0.1 * width and top >= 0.0 and bottom <= rows - 1.0
        and -0.06 <= slant <= 0.32
    )  # fmt: skip
