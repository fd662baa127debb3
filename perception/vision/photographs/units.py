"""Reads the unit that is printed on the face of a gauge.

Pieces of ink that stand beside each other on one line are a word. It is parted into the letters of each unit in the likeliest way,
by a network that recognises single letters. Which of two units belongs to which scale is not told by their letters, so that a face
with two has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from perception.vision.photographs.numerals import RADIUS_PX, face_around
from perception.vision.photographs.printed_characters import inks, strong
from perception.vision.photographs.printed_digits import Float32, Network, cell_of

FILE = Path(__file__).with_name("printed_letters.npz")
GLYPHS = ("2", "a", "A", "b", "B", "cC", "f", "g", "iIl1", "kK", "m", "M", "n", "pP", "r", "R", "sS", "/")
"""What the network tells apart: characters that differ by their size alone count as one."""
UNITS = {
    "bar": "bar", "BAR": "bar", "mbar": "mbar", "psi": "psi", "PSI": "psi", "kPa": "kPa", "KPA": "kPa", "MPa": "MPa", "MPA": "MPa",
    "kg/cm": "kg/cm2", "kg/cm2": "kg/cm2", "kgf/cm": "kg/cm2", "kgf/cm2": "kg/cm2", "rpm": "rpm", "RPM": "rpm", "l/min": "l/min",
}  # fmt: skip
"""Spellings, also without powers, which are often smaller, and what they mean."""
WITHIN = 0.78  # distance from the middle, over the radius, of all of the word
LETTER_PX = (8.0, 60.0)  # height of a letter
SLENDER, WIDE = 0.1, 1.6  # ratio of its width to its height
NEAREST, FARTHEST = -0.15, 0.45  # gap between letters, over the height of the taller one
LEVEL = 0.4  # least share of the lower one's height that stands beside the other
NARROWEST, WIDEST = 1.0, 6.0  # ratio of a word's width to its height
ALONE = 0.3  # of a word's height, on both sides of it
PARTED = 0.6  # of the strongest column's ink, below which letters may be parted
LEAST_PROBABILITY, LEAST_WORD = 1e-3, 0.3  # of a letter; geometric mean of those of a word


@cache
def shipped_letters() -> Network:
    """Return the network that the package carries; it gives the probabilities of `GLYPHS`, and of anything else."""
    return Network.load(FILE)


def find_unit(gray: Image, u: float, v: float, radius: float) -> str:
    """Return the unit on a dial; empty if none is legible, or more than one.

    Args:
        gray: (H, W) uint8.
        u, v, radius: the dial in it, px.
    """
    face = face_around(gray, u, v, radius)
    found = {UNITS[word] for ink in inks(face) for is_strong in strong(ink) for word in _words(ink, is_strong)}
    return found.pop() if len(found) == 1 else ""


def _words(ink: Float32, is_strong: NDArray[np.bool_]) -> Iterator[str]:
    """Yield the spellings of units that the strong part of some ink shows."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_strong.astype(np.uint8), connectivity=8)
    pieces = [k for k in range(1, len(stats)) if _may_be_letters(*stats[k, :4].tolist())]
    for row in _rows(stats[pieces, :4].astype(float)):
        own = [pieces[k] for k in row]
        low, high = stats[own, :2].min(axis=0), (stats[own, :2] + stats[own, 2:4]).max(axis=0)
        wide, tall = high - low
        if NARROWEST * tall < wide < WIDEST * tall and _stands_alone(np.asarray(labels, np.int32), own, low, high):
            cut = np.s_[low[1] : high[1], low[0] : high[0]]
            yield from _spelt(np.where(np.isin(labels[cut], own), ink[cut], 0.0).astype(np.float32))


def _stands_alone(labels: NDArray[np.int32], own: Sequence[int], low: Array, high: Array) -> bool:
    """Return whether there is no ink left and right of a word that could hide or be another letter of it."""
    beside = round(ALONE * (high[1] - low[1]))
    rows = slice(low[1], high[1])
    sides = (labels[rows, max(low[0] - beside, 0) : low[0]], labels[rows, high[0] : high[0] + beside])
    return all(bool(np.isin(side, [0, *own]).all()) for side in sides)


def _spelt(strip: Float32) -> Iterator[str]:
    """Yield the spelling of a unit that the ink of a row (H, W) shows, if it shows one.

    Where letters touch, they are parted at columns with less ink than beside. Of all ways to part the row into the letters
    of a spelling the likeliest one counts, which is found letter by letter (Viterbi, 1967).
    """
    cuts = _cuts(strip)
    first, last = np.triu_indices(len(cuts), 1)
    sized = np.array([SLENDER <= (cuts[j] - cuts[i]) / len(strip) <= WIDE for i, j in zip(first, last, strict=True)])
    parts = [(i, j, part) for i, j in zip(first[sized], last[sized], strict=True)
             if (part := _trimmed(strip[:, cuts[i] : cuts[j]])) is not None]  # fmt: skip
    if not parts:
        return
    letters = shipped_letters().probabilities(np.array([cell_of(part) for _, _, part in parts]))
    likely = np.full((len(cuts), len(cuts), letters.shape[1]), LEAST_PROBABILITY)
    for (i, j, _), one in zip(parts, letters, strict=True):
        likely[i, j] = np.maximum(one, LEAST_PROBABILITY)
    fits = {spelling: _fit(spelling, np.log(likely)) for spelling in UNITS}
    best = max(fits, key=lambda spelling: fits[spelling])
    if fits[best] > LEAST_WORD:
        yield best


def _cuts(strip: Float32) -> list[int]:
    """Return the columns at which a row of ink begins, may be parted, and ends."""
    column = np.concatenate([[np.inf], strip.sum(axis=0), [np.inf]])
    middle = column[1:-1]
    is_least = (middle <= column[:-2]) & (middle < column[2:]) & (middle < PARTED * strip.sum(axis=0).max())
    inner = [int(k) for k in np.flatnonzero(is_least) if 0 < k < strip.shape[1] - 1]
    return [0, *inner, strip.shape[1]]


def _trimmed(part: Float32) -> Float32 | None:
    """Return a part of a row, cut out closely; None if it has no ink, or less height than a letter."""
    rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    if len(rows) == 0 or rows[-1] - rows[0] < LETTER_PX[0] - 1:
        return None
    return part[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def _fit(spelling: str, log_likely: Array) -> float:
    """Return the geometric mean of the probabilities of the letters of a spelling, parted in the likeliest way.

    Args:
        log_likely: (cuts, cuts, glyphs) of what stands between two cuts.
    """
    reached = np.full(len(log_likely), -np.inf)
    reached[0] = 0.0
    for letter in spelling:
        reached = (reached[:, None] + log_likely[:, :, _glyph(letter)]).max(axis=0)
    return float(np.exp(reached[-1] / len(spelling)))


def _may_be_letters(x: float, y: float, wide: float, tall: float) -> bool:
    """Return whether a piece of ink has the size and the place of one or several letters of a unit."""
    middle = 1.05 * RADIUS_PX
    off = np.hypot(max(abs(x - middle), abs(x + wide - middle)), y + tall / 2 - middle)
    is_sized = LETTER_PX[0] < tall < LETTER_PX[1] and SLENDER * tall < wide < WIDEST * tall
    return bool(is_sized and off < WITHIN * RADIUS_PX)


def _rows(boxes: Array) -> Iterator[list[int]]:
    """Yield the rows of pieces (N, 4) that stand beside each other, from left to right, none of them a part of another."""
    after = [_right_of(boxes, k) for k in range(len(boxes))]
    for first in set(range(len(boxes))) - {one for one in after if one is not None}:
        row, following = [first], after[first]
        while following is not None and following not in row:
            row.append(following)
            following = after[following]
        yield row


def _right_of(boxes: Array, which: int) -> int | None:
    """Return the piece that stands next on the right of one; None if there is none."""
    x, y, w, h = boxes.T
    tall = np.maximum(h, h[which])
    gap = (x - x[which] - w[which]) / tall
    shared = np.minimum(y + h, y[which] + h[which]) - np.maximum(y, y[which])
    is_next = (gap > NEAREST) & (gap < FARTHEST) & (shared > LEVEL * np.minimum(h, h[which])) & (x > x[which])
    candidates = np.flatnonzero(is_next)
    return int(candidates[gap[candidates].argmin()]) if len(candidates) else None


@cache
def _glyph(letter: str) -> int:
    """Return the class of a letter."""
    return next(k for k, glyph in enumerate(GLYPHS) if letter in glyph)
