"""Search for rows of seven-segment digits in a picture of which nothing is known.

The picture is scaled so that a digit of each tried height becomes CELL_PX high. Then, for dark and for bright ink, two
slants and two widths, the cell at every place is scored by the share of the ink around it that its best character
explains. Neighbouring good cells of the same height and polarity form a row. Window, frame and contrast are not used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.jit import compiled
from perception.vision.noise import noise_sigma
from perception.vision.status.digit_grid import LIT_SHARES
from perception.vision.status.digit_grid_worth import Float32, cell_boxes

CELL_PX = 24.0  # distance between the axes of the top and bottom segments
STRIDE = 2  # distance in px between the tried places
STEP = 1.25  # ratio of successive heights
# Least height of a digit in the picture, and its largest ratio to the picture's smaller side.
LEAST_PX, MOST_SHARE = 18.0, 0.7
SLANTS = (0.02, 0.15)  # tried tangents of the digits' slant
WIDTHS = (0.44, 0.56)  # tried ratios of width to height
KERNEL_PX = 13  # wider than any stroke of such a digit
MARGIN = 0.16  # of the height, around a cell; ink there counts as unexplained
LEAST_SHARE = 0.35  # of the ink explained
NOISE_SIGMAS = 2.0
PLAIN = 0.3  # factor on the score of a cell with few segments, because any bar resembles a one
MOST_CELLS = 60
MOST_ROWS = 8
# For cells of one row: ratio of heights, and distances relative to the height.
SAME_HEIGHT, SAME_ROW, NEXT_CELL = 1.35, 0.3, 2.2


@dataclass(frozen=True, slots=True, kw_only=True)
class DigitCell:
    """A place that resembles a digit: upper left corner of its axes and size, px of the picture; score, 0 to 1."""

    u: float
    v: float
    width: float
    height: float
    is_dark: bool
    score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DigitRow:
    """Cells side by side: the box around their axes, px; height of a digit; polarity; sum of their scores."""

    left: float
    top: float
    right: float
    bottom: float
    height: float
    is_dark: bool
    score: float


def find_digit_rows(gray: Image) -> list[DigitRow]:
    """Return the likeliest rows of digits, best first, at most MOST_ROWS.

    Args:
        gray: (H, W) uint8.
    """
    cells = sorted(_cells(gray), key=lambda cell: cell.score, reverse=True)
    kept: list[DigitCell] = []
    for cell in cells:
        if len(kept) >= MOST_CELLS:
            break
        if not any(_overlap(cell, other) for other in kept):
            kept.append(cell)
    return _rows(kept)


def _cells(gray: Image) -> Iterator[DigitCell]:
    """Yield the cells of all tried heights and both polarities."""
    height = LEAST_PX
    while height <= MOST_SHARE * min(gray.shape):
        scale = CELL_PX / height
        size = (max(8, round(gray.shape[1] * scale)), max(8, round(gray.shape[0] * scale)))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        small = np.asarray(cv2.resize(gray, size, interpolation=how), np.uint8)
        for is_dark in (True, False):
            yield from _cells_of_height(_ink(small, is_dark), is_dark, scale)
        height *= STEP


def _ink(small: Image, is_dark: bool) -> Float32:
    """Return the ink: bright or dark strokes by a white or black top-hat, minus the noise."""
    smooth = cv2.GaussianBlur(small, (3, 3), 0)
    operation = cv2.MORPH_BLACKHAT if is_dark else cv2.MORPH_TOPHAT
    hat = cv2.morphologyEx(smooth, operation, np.ones((KERNEL_PX, KERNEL_PX), np.uint8)).astype(np.float32)
    return np.asarray(np.maximum(hat - 1.0 - NOISE_SIGMAS * 0.5 * noise_sigma(small), 0.0), np.float32)


def _cells_of_height(ink: Float32, is_dark: bool, scale: float) -> Iterator[DigitCell]:
    """Yield the cells in a picture that is scaled by `scale`."""
    middle = (len(ink) - 1) / 2
    for slant in SLANTS:
        shear = np.array([[1.0, -slant, slant * middle], [0.0, 1.0, 0.0]])
        upright = cv2.warpAffine(ink, shear, ink.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        sums = np.asarray(cv2.integral(upright, sdepth=cv2.CV_64F), float)
        squares = np.asarray(cv2.integral(upright * upright, sdepth=cv2.CV_64F), float)
        for ratio in WIDTHS:
            width = ratio * CELL_PX
            boxes = cell_boxes(0.0, CELL_PX, width)
            scores = cell_scores(sums, squares, boxes, width, LIT_SHARES)
            for i, j in zip(*_peaks(scores), strict=True):
                v = float(i * STRIDE)
                u = j * STRIDE - slant * (v + CELL_PX / 2 - middle)
                yield DigitCell(u=u / scale, v=v / scale, width=width / scale, height=CELL_PX / scale, is_dark=is_dark,
                           score=float(scores[i, j]))  # fmt: skip


def _peaks(scores: Float32) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of the local maxima above the threshold."""
    near = cv2.dilate(scores, np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero((scores >= near) & (scores > LEAST_SHARE * PLAIN))
    return rows, columns


@compiled
def cell_scores(sums: Array, squares: Array, boxes: Array, width: float, lit: Array) -> Float32:
    """Return the share of the ink's energy around a cell that its best character explains, for cells at all places.

    Args:
        sums, squares: integral images of the upright ink, and of its square.
        boxes: (9, 4) of a cell at the origin (see `digit_grid_worth.cell_boxes`).
        width: of a cell.
        lit: (characters, 7) 1 if a segment is lit.

    Returns: (h, w), one value every STRIDE px.
    """
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    border = int(MARGIN * CELL_PX)
    high, wide = int(CELL_PX) + 2 * border, int(width) + 2 * border
    out = np.zeros((max(1, rows // STRIDE), max(1, columns // STRIDE)), np.float32)
    least = float(high * wide)
    offsets = np.zeros((9, 4), np.int64)
    for b in range(7):
        for e in range(4):
            offsets[b, e] = int(np.floor(boxes[b, e] + 0.5))
    for i in range(border // STRIDE + 1, (rows - high + border) // STRIDE):
        y = i * STRIDE
        for j in range(border // STRIDE + 1, (columns - wide + border) // STRIDE):
            x = j * STRIDE
            top, left = y - border, x - border
            bottom, right = top + high, left + wide
            energy = squares[bottom, right] - squares[top, right] - squares[bottom, left] + squares[top, left]
            if energy < least:  # less than one gray level on average
                continue
            best = 0.0
            for g in range(lit.shape[0]):
                area = total = 0.0
                count = 0
                for s in range(7):
                    if lit[g, s] > 0.0:
                        x0, y0, x1, y1 = offsets[s, 0], offsets[s, 1], offsets[s, 2], offsets[s, 3]
                        area += (x1 - x0) * (y1 - y0)
                        total += (
                            sums[y + y1, x + x1] - sums[y + y0, x + x1] - sums[y + y1, x + x0] + sums[y + y0, x + x0]
                        )
                        count += 1
                share = total * total / area / energy * (1.0 if count > 3 else PLAIN)
                best = max(best, share)
            out[i, j] = best
    return out


def _overlap(a: DigitCell, b: DigitCell) -> bool:
    """Return whether two cells cover each other by a third or more."""
    across = min(a.u + a.width, b.u + b.width) - max(a.u, b.u)
    down = min(a.v + a.height, b.v + b.height) - max(a.v, b.v)
    return across > 0 and down > 0 and across * down > 0.33 * min(a.width * a.height, b.width * b.height)


def _rows(cells: list[DigitCell]) -> list[DigitRow]:
    """Join neighbouring cells into rows, beginning with the best cell; returns the rows, best first."""
    free = list(cells)
    rows: list[DigitRow] = []
    while free and len(rows) < MOST_ROWS:
        row = [free.pop(0)]
        grown = True
        while grown:
            near = [cell for cell in free if any(_beside(cell, other) for other in row)]
            free = [cell for cell in free if not any(cell is taken for taken in near)]
            row += near
            grown = bool(near)
        rows.append(_row(row))
    return sorted(rows, key=lambda row: row.score, reverse=True)


def _beside(a: DigitCell, b: DigitCell) -> bool:
    """Return whether two cells may belong to one row."""
    height = max(a.height, b.height)
    gap = max(a.u, b.u) - min(a.u + a.width, b.u + b.width)
    return (
        a.is_dark == b.is_dark
        and height <= SAME_HEIGHT * min(a.height, b.height)
        and abs(a.v + a.height / 2 - b.v - b.height / 2) <= SAME_ROW * height
        and gap <= NEXT_CELL * height
    )


def _row(cells: list[DigitCell]) -> DigitRow:
    """Return a row with the given cells."""
    weights = np.array([cell.score for cell in cells])
    height = float(np.average([cell.height for cell in cells], weights=weights))
    return DigitRow(
        left=min(cell.u for cell in cells), right=max(cell.u + cell.width for cell in cells),
        top=float(np.average([cell.v for cell in cells], weights=weights)),
        bottom=float(np.average([cell.v + cell.height for cell in cells], weights=weights)),
        height=height, is_dark=cells[0].is_dark, score=float(weights.sum()),
    )  # fmt: skip
