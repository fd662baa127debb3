"""Search for the digit cells of a seven-segment display: the slant, rows, pitch and width that fit characters best.

The slant is the one whose sheared picture has the sharpest columns. For every likely pair of rows and every width, the
worth of a cell is computed along the picture (see `digit_grid_worth`); a grid is the pitch and phase with the largest
total. The best few grids are refined continuously. The number of cells need not be known, because blank cells are worth
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array
from perception.vision.status.digit_grid_fit import refine_grid
from perception.vision.status.digit_grid_worth import (
    INNER,
    LOOP,
    STROKE,
    Float32,
    guesses,
    row_scores,
    slant_energies,
)
from perception.vision.status.glyphs import LIT
from perception.vision.status.ink import column_levels, level_at

#: Ends of every segment's axis in a cell of unit width and height, y down.
AXES = np.array([
    [[0, 0], [1, 0]], [[1, 0], [1, 0.5]], [[1, 0.5], [1, 1]], [[0, 1], [1, 1]], [[0, 0.5], [0, 1]], [[0, 0], [0, 0.5]],
    [[0, 0.5], [1, 0.5]],
])  # fmt: skip
SLANTS = np.tan(np.deg2rad(np.arange(-2.0, 16.1, 2.0)))
WIDTHS = np.array([0.40, 0.49, 0.60])  # candidate distances between the uprights' axes, in digit heights
PITCHES = np.geomspace(1.25, 2.6, 16)  # candidate pitches, in cell widths
HEIGHTS = np.geomspace(0.34, 0.94, 10)  # candidate digit heights, as shares of the picture's height
ROWS_TRIED = 4
REFINED = 2
REFINE_STEPS = np.array([0.05, 0.025, 0.012])  # of the digit height
EVEN_OUT = 0.45  # dimmer parts of the picture are amplified until their ink reaches this share of the strongest
LIT_SHARES = LIT.astype(float)


@dataclass(frozen=True, slots=True, kw_only=True)
class DigitGrid:
    """Evenly spaced digit cells.

    `left_px` is the axis of the first cell's left uprights at half height; `top_px` and `bottom_px` are the axes of the top
    and bottom segments, `slant` is the tangent of the lean to the right.
    """

    left_px: float
    pitch_px: float
    width_px: float
    top_px: float
    bottom_px: float
    slant: float
    count: int

    @property
    def gap(self) -> float:
        """Gap between the uprights of neighbouring cells, in digit heights."""
        return (self.pitch_px - self.width_px) / self.height_px

    @property
    def height_px(self) -> float:
        """Distance between the axes of the top and bottom segments."""
        return self.bottom_px - self.top_px

    @property
    def numbers(self) -> Array:
        """(6,) left, pitch, width, top, bottom, slant, in the order that the compiled routines expect."""
        return np.array([self.left_px, self.pitch_px, self.width_px, self.top_px, self.bottom_px, self.slant])

    def place(self, x: Array, y: Array, cell: Array) -> tuple[Array, Array]:
        """Return pixel coordinates of a place in a cell: x from 0 (left upright) to 1, y from 0 (top) to 1."""
        v = self.top_px + y * (self.bottom_px - self.top_px)
        lean = self.slant * ((self.top_px + self.bottom_px) / 2 - v)
        return self.left_px + cell * self.pitch_px + x * self.width_px + lean, v


def find_digit_grids(ink: Float32, seen: Float32, *, most: int = 8, free: float = 0.5) -> list[tuple[float, DigitGrid]]:
    """Return the most promising grids with their worth, best first; an empty list if no ink stands out.

    Args:
        ink: (H, W) how much every pixel differs from the background as segments do; 0 where nothing is visible.
        seen: (H, W) 1 where the display is visible, 0 where something hides it.
        most: maximum number of cells.
        free: largest distance of the grid's middle from the picture's, as a share of the picture's width.
    """
    even = _evened(ink)
    flat = _flat_ink(even)
    rows = _row_pairs(ink, even, flat)
    if len(rows) == 0:
        return []
    slant = _slant(even, flat)
    whole = bool(seen.min() > 0)  # if nothing is hidden, `seen` need not be evaluated
    upright, clear = _upright(even, slant), seen if whole else _upright(seen, slant)
    sums = np.asarray(cv2.integral(upright, sdepth=cv2.CV_64F), float)
    shares = sums if whole else np.asarray(cv2.integral(clear, sdepth=cv2.CV_64F), float)
    rough = guesses(sums, shares, whole, rows, WIDTHS, PITCHES, most, free, LIT_SHARES)
    found = []
    for guess in rough[np.argsort(-rough[:, 0])][:REFINED]:
        if guess[0] <= 0:
            break
        found.append(_refined(upright, clear, whole, guess, slant))
    return sorted(found, key=lambda f: f[0], reverse=True)


def _refined(upright: Float32, clear: Float32, whole: bool, guess: Array, slant: float) -> tuple[float, DigitGrid]:
    """Return worth and grid after continuous refinement of a guess."""
    _, left, pitch, width, top, height, count = (float(value) for value in guess)
    place = np.array([left, pitch, width, top, top + height, 0.0])
    means, shares = segment_means(upright, clear, whole, width, height)
    worth = refine_grid(means, shares, whole, place, int(count), LIT_SHARES, REFINE_STEPS, slant)
    left, pitch, width, top, bottom, rest = (float(value) for value in place)
    left += slant * ((len(upright) - 1) / 2 - (top + bottom) / 2)  # shearing keeps the picture's middle row in place
    return float(worth), DigitGrid(
        left_px=left, pitch_px=pitch, width_px=width, top_px=top, bottom_px=bottom, slant=slant + rest, count=int(count)
    )


def segment_means(
    upright: Float32, clear: Float32, whole: bool, width_px: float, height_px: float
) -> tuple[Float32, Float32]:
    """Return the box means that `digit_grid_fit.grid_worth` looks up; a box has the size of a segment of such cells."""
    stroke = round(2 * STROKE * height_px) | 1
    boxes = (
        (round((1 - 2 * INNER) * width_px) | 1, stroke),
        (stroke, round((1 - 2 * INNER) * height_px / 2) | 1),
    )
    loop = (round(2 * LOOP * width_px) | 1, round(LOOP * height_px) | 1)
    border = cv2.BORDER_CONSTANT
    means = [cv2.blur(upright, box, borderType=border) for box in boxes]
    means.append(cv2.blur(upright * upright, loop, borderType=border))
    shares = np.ones((2, 1, 1)) if whole else [cv2.blur(clear, box, borderType=border) for box in boxes]
    return np.asarray(means, np.float32), np.asarray(shares, np.float32)


def _evened(ink: Float32) -> Float32:
    """Return the ink with dim stretches amplified: behind glare or in grazing light segments are merely weaker."""
    high = column_levels(ink, 0.92)[None]
    reach = max(3, len(ink) // 2) | 1
    wide = cv2.GaussianBlur(cv2.dilate(high, np.ones((1, reach), np.uint8)), (0, 0), reach / 4)
    least = max(float(wide.max()) * EVEN_OUT, 1e-6)
    return np.asarray(ink * (wide.max() / np.maximum(wide, least)), np.float32)


def _flat_ink(even: Float32) -> Float32:
    """Return the part of the ink that is wider than an upright."""
    return np.asarray(cv2.erode(even, np.ones((1, max(3, len(even) // 9) | 1), np.uint8)), np.float32)


def _slant(even: Float32, flat: Float32) -> float:
    """Return the tangent of the slant to the right at which the uprights' columns are sharpest."""
    uprights = cv2.subtract(even, cv2.dilate(flat, np.ones((1, max(3, len(even) // 9) | 1), np.uint8)))
    energies = slant_energies(np.asarray(cv2.GaussianBlur(uprights, (3, 1), 0), np.float32), SLANTS)
    k = int(energies.argmax())
    return float(SLANTS[k])


def _upright(image: Float32, slant: float) -> Float32:
    """Return the picture sheared about its middle row so that slanted uprights become vertical."""
    if slant == 0.0:
        return image
    middle = (len(image) - 1) / 2
    shear = np.array([[1.0, -slant, slant * middle], [0.0, 1.0, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, shear, image.shape[::-1], flags=flags), np.float32)


def _row_pairs(ink: Float32, even: Float32, flat: Float32) -> Array:
    """Return top and height (N, 2) of likely digits.

    They are three equidistant rows of flat segments, or the rows where ink begins and ends.
    """
    rows = len(ink)
    profile = (cv2.GaussianBlur(flat, (1, 3), 0) ** 2).sum(axis=1, dtype=float)
    if profile.max() <= 0:
        return np.zeros((0, 2))
    found = _extent(ink)
    # The bottom segment may be too dim to show
    found += [(top, 1.12 * height) for top, height in found if top + 1.12 * height < rows - 1]
    found += [
        pair for pair in _extent(even) if all(abs(pair[0] - t) + abs(pair[1] - h) > 0.06 * rows for t, h in found)
    ]
    tried = row_scores(profile, HEIGHTS * rows, max(1.0, 0.025 * rows))
    for score, top, height in tried[np.argsort(-tried[:, 0])].tolist():
        if len(found) >= ROWS_TRIED or score <= 0:
            break
        if all(abs(top - t) + abs(top + height - t - h) > 0.1 * rows for t, h in found):
            found.append((top, height))
    return np.array(found).reshape(-1, 2)


def _extent(ink: Float32) -> list[tuple[float, float]]:
    """Return the rows of the top and bottom segments' axes, estimated from where the ink begins and ends."""
    strong = level_at(ink, 0.99)
    profile = np.count_nonzero(ink > 0.45 * strong, axis=1)
    there = np.flatnonzero(profile >= max(2.0, 0.15 * profile.max()))
    if strong <= 0 or len(there) < 6 or there[-1] - there[0] < 0.25 * len(ink):
        return []
    half_stroke = STROKE * (there[-1] - there[0])
    return [(float(there[0] + half_stroke), float(there[-1] - there[0] - 2 * half_stroke))]
