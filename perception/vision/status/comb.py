"""Where the digit cells of a seven-segment display are: slant, rows, pitch and width whose cells make the best characters.

For every coarse slant, row pair and width, the worth of a cell is known at every column (see comb_jit); a comb is the pitch
and phase that collect the most. The best few are refined continuously. How many cells there are need not be known:
blank ones are worth nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perception.vision.patch import sample_at
from perception.vision.status.comb_jit import (
    INNER,
    LEAST_GAP,
    PARTS,
    STROKE,
    Float32,
    best_pitch,
    refine_comb,
    worth_along,
)
from perception.vision.status.glyphs import LIT
from perception.vision.view import Array

#: Ends of every segment's axis in a cell of unit width and height, y down.
AXES = np.array([
    [[0, 0], [1, 0]], [[1, 0], [1, 0.5]], [[1, 0.5], [1, 1]], [[0, 1], [1, 1]], [[0, 0.5], [0, 1]], [[0, 0], [0, 0.5]],
    [[0, 0.5], [1, 0.5]],
])  # fmt: skip
SLANTS = np.tan(np.deg2rad([0.0, 5.0, 11.0]))
WIDTHS = np.array([0.40, 0.49, 0.60])  # between the uprights' axes, over the digit height
PITCHES = np.geomspace(1.25, 2.6, 26)  # over that width
HEIGHTS = np.geomspace(0.34, 0.94, 10)  # of a digit over the picture's
ROWS_TRIED = 6
REFINED = 1  # of every slant
REFINE_STEPS = np.array([0.05, 0.025, 0.012])  # of the digit height
EVEN_OUT = 0.45  # dimmer parts of the picture are raised until their ink reaches this share of the strongest


@dataclass(frozen=True, slots=True, kw_only=True)
class Comb:
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
        """Between neighbours' uprights, over the digit height."""
        return (self.pitch_px - self.width_px) / self.height_px

    @property
    def height_px(self) -> float:
        """Between the axes of the top and the bottom segments."""
        return self.bottom_px - self.top_px

    def place(self, x: Array, y: Array, cell: Array) -> tuple[Array, Array]:
        """Pixel of cell coordinates: x from 0 (left upright) to 1, y from 0 (top) to 1."""
        v = self.top_px + y * (self.bottom_px - self.top_px)
        lean = self.slant * ((self.top_px + self.bottom_px) / 2 - v)
        return self.left_px + cell * self.pitch_px + x * self.width_px + lean, v


def find_combs(ink: Float32, seen: Float32, *, most: int = 8, free: float = 0.5) -> list[tuple[float, Comb]]:
    """(worth, comb) of the most promising combs, best first; none where no ink stands out.

    Args:
        ink: (H, W) how much every pixel differs from the background, as segments do; 0 where nothing is seen.
        seen: (H, W) 1 where the display is seen, 0 where something hides it.
        most: number of cells at most.
        free: how far the comb's middle may lie from the picture's, over its width.
    """
    even = _evened(ink)
    rows = _row_pairs(ink, even)
    if not rows:
        return []
    chosen: list[tuple[float, Array, int]] = []
    for slant in SLANTS:
        sums = tuple(np.asarray(cv2.integral(_upright(image, float(slant))), float) for image in (even, seen))
        rough = [
            guess
            for top, height in rows
            for guess in _guesses((sums[0], sums[1]), top, height, float(slant), most, free)
        ]
        chosen += sorted(rough, key=lambda guess: guess[0], reverse=True)[:REFINED]
    found = []
    for _, place, count in chosen:
        score = float(refine_comb(even, seen, place, count, AXES, LIT, REFINE_STEPS))
        if score > 0:
            left, pitch, width, top, bottom, slant = (float(p) for p in place)
            found.append((score, Comb(left_px=left, pitch_px=pitch, width_px=width, top_px=top, bottom_px=bottom,
                                      slant=slant, count=count)))  # fmt: skip
    return sorted(found, key=lambda f: f[0], reverse=True)


def _guesses(
    sums: tuple[Array, Array], top: float, height: float, slant: float, most: int, free: float
) -> list[tuple[float, Array, int]]:
    """(worth, comb, cells) of the best upright comb of every width between two rows of an upright picture."""
    found = []
    worth = np.empty(sums[0].shape[1] - 1)
    for width in WIDTHS * height:
        pitches = PITCHES * width
        pitches = pitches[pitches - width >= LEAST_GAP * height]
        worth_along(sums[0], sums[1], top, height, float(width), LIT, worth)
        score, left, pitch, count = best_pitch(worth, pitches, float(width), height, most, free)
        if score > 0:
            found.append((score, np.array([left, pitch, width, top, top + height, slant]), count))
    return found


def _evened(ink: Float32) -> Float32:
    """The ink with dim stretches raised: behind glare and at grazing light, segments are as sure but weaker."""
    rows = len(ink)
    high = np.percentile(ink, 92, axis=0).astype(np.float32)[None]
    reach = max(3, rows // 2) | 1
    wide = cv2.GaussianBlur(cv2.dilate(high, np.ones((1, reach), np.uint8)), (0, 0), reach / 4)
    least = max(float(wide.max()) * EVEN_OUT, 1e-6)
    return np.asarray(ink * (wide.max() / np.maximum(wide, least)), np.float32)


def _upright(image: Float32, slant: float) -> Float32:
    """The picture sheared about its middle row, so that leaning uprights stand."""
    if slant == 0.0:
        return image
    middle = (len(image) - 1) / 2
    shear = np.array([[1.0, -slant, slant * middle], [0.0, 1.0, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, shear, image.shape[::-1], flags=flags), np.float32)


def _row_pairs(ink: Float32, even: Float32) -> list[tuple[float, float]]:
    """(top, height) of likely digits: three rows of flat segments at equal distances, or where the ink begins and ends."""
    rows = len(ink)
    flat = cv2.erode(even, np.ones((1, max(3, rows // 9) | 1), np.uint8))  # uprights are narrower than that
    profile = (cv2.GaussianBlur(flat, (1, 3), 0).astype(float) ** 2).sum(axis=1)
    if profile.max() <= 0:
        return []
    tried = []
    for height in HEIGHTS * rows:
        tops = np.arange(0.02 * rows, 0.98 * rows - height, max(1.0, 0.025 * rows))
        at = [np.interp(tops + y * height, np.arange(rows), profile) for y in (0.0, 0.25, 0.5, 0.75, 1.0)]
        score = at[0] + at[2] + at[4] + 2.0 * np.minimum(np.minimum(at[0], at[2]), at[4]) - 1.2 * (at[1] + at[3])
        tried += [(float(s), float(t), float(height)) for s, t in zip(score, tops, strict=True)]
    tried.sort(reverse=True)
    found = _extent(ink)
    found += [(top, 1.12 * height) for top, height in found if top + 1.12 * height < rows - 1]  # a dim bottom
    found += [
        pair for pair in _extent(even) if all(abs(pair[0] - t) + abs(pair[1] - h) > 0.06 * rows for t, h in found)
    ]
    for score, top, height in tried:
        if len(found) >= ROWS_TRIED or score <= 0:
            break
        if all(abs(top - t) + abs(top + height - t - h) > 0.1 * rows for t, h in found):
            found.append((top, height))
    return found


def _extent(ink: Float32) -> list[tuple[float, float]]:
    """Rows of the top and bottom segments' axes, by where the ink begins and ends."""
    strong = float(np.percentile(ink, 99))
    profile = (ink > 0.45 * strong).sum(axis=1)
    there = np.flatnonzero(profile >= max(2.0, 0.15 * profile.max()))
    if strong <= 0 or len(there) < 6 or there[-1] - there[0] < 0.25 * len(ink):
        return []
    half_stroke = STROKE * (there[-1] - there[0])
    return [(float(there[0] + half_stroke), float(there[-1] - there[0] - 2 * half_stroke))]


def segment_levels(ink: Float32, seen: Float32, comb: Comb) -> tuple[Array, Array]:
    """(cells, 7) ink of every segment, the median along its axis of the best across its stroke, and its seen share."""
    height = comb.height_px
    start, end = AXES[:, 0], AXES[:, 1]
    along = np.linspace(INNER, 1 - INNER, PARTS)
    axis = start[:, None, :] + along[None, :, None] * (end - start)[:, None, :]  # (7, along, 2)
    flat = (start[:, 1] == end[:, 1])[:, None, None]
    across = np.array([-1.0, 0.0, 1.0]) * STROKE * 0.8
    cell = np.arange(comb.count, dtype=float)[:, None, None, None]
    u, v = comb.place(axis[None, :, :, 0, None], axis[None, :, :, 1, None], cell)
    v = v + np.where(flat, across, 0.0)[None] * height
    u = u + np.where(flat, 0.0, across)[None] * height
    u, v = np.broadcast_arrays(u, v)
    lines = (comb.count, -1)
    values, there = (
        sample_at(image, u.reshape(lines), v.reshape(lines), outside=0.0).reshape(u.shape) for image in (ink, seen)
    )
    clear = there > 0.6
    best = np.where(clear, values, -1.0).max(axis=3)
    good = clear[..., 1] & (clear.sum(axis=3) >= 2)  # the outer part alone is no witness: a stroke may be narrower
    ordered = np.sort(np.where(good, best, np.inf), axis=2)  # what is hidden comes last
    n = good.sum(axis=2)
    low, high = (
        np.take_along_axis(ordered, k[..., None], 2)[..., 0]
        for k in (np.maximum(n - 1, 0) // 2, np.minimum(n // 2, PARTS - 1))
    )
    levels = np.where(n > 0, 0.5 * (np.where(n > 0, low, 0.0) + np.where(n > 0, high, 0.0)), 0.0)
    return np.asarray(levels, float), np.asarray(good.mean(axis=2), float)


def loop_levels(ink: Float32, seen: Float32, comb: Comb) -> tuple[Array, Array]:
    """(cells,) mean and standard deviation of the ink inside the loops of every cell, where no segment is; NaN unseen."""
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(0.36, 0.64, 3), [0.2, 0.25, 0.3, 0.7, 0.75, 0.8]))
    cell = np.arange(comb.count, dtype=float)[:, None]
    u, v = comb.place(x[None], y[None], cell)
    u, v = np.broadcast_arrays(u, v)
    values = sample_at(ink, u, v, outside=0.0).astype(float)
    clear = sample_at(seen, u, v, outside=0.0) > 0.6
    values = np.where(clear, values, 0.0)
    n = clear.sum(axis=1)
    mean = values.sum(axis=1) / np.maximum(n, 1)
    spread = np.sqrt((np.where(clear, values - mean[:, None], 0.0) ** 2).sum(axis=1) / np.maximum(n, 1))
    return np.where(n >= 6, mean, np.nan), np.where(n >= 6, spread, np.nan)
