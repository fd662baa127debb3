"""Decoding of seven-segment levels: likelihoods of characters, and numbers as blanks, an optional sign, then digits.

A segment's level is normally distributed around the level of the lit segments of its cell, or around that of the unlit
ones. A hidden segment carries no information, so whatever it would have decided stays undecided. Every number that is
about as likely as the best is listed; a range or a previous reading may decide between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import prod

import numpy as np

from hal.arrays import Array

SEGMENTS = "abcdefg"  # top, upper right, lower right, bottom, lower left, upper left, middle
GLYPHS = (
    ("0", "abcdef"), ("1", "bc"), ("2", "abged"), ("3", "abgcd"), ("4", "fgbc"), ("5", "afgcd"), ("6", "afgedc"),
    ("7", "abc"), ("8", "abcdefg"), ("9", "abcdfg"), ("7", "abcf"), ("6", "fgedc"), ("9", "abcfg"), ("-", "g"),
)  # fmt: skip
# (characters, 7) which segments each character lights.
LIT = np.array([[s in lit for s in SEGMENTS] for _, lit in GLYPHS])
NAMES = [name for name, _ in GLYPHS]
OTHER_FORMS = [(int(name), k) for k, name in enumerate(NAMES) if k >= 10 and name.isdigit()]
RARE = {10: 1.5, 11: 1.5, 12: 1.5}  # nats of penalty: other ways to draw 7, 6 and 9

LEAST_NOISE = 1.0  # levels
LEVEL_NOISE = 0.8  # as a share of the ink's spread: a level is the median of five places, each the best of three
LEAST_SEEN = 0.19  # visible share of a segment below which it is ignored
SPREAD = 0.16  # standard deviation of a lit segment's level over that level: uneven light, blur, pixels
LEAK = 0.15  # the same for an unlit segment, which receives blur from its lit neighbours
CELL_SPREAD = 0.4  # standard deviation of the logarithm of a cell's lit level over the display's
MOST_LOSS = 9.0  # largest penalty (nats) per segment, because larger deviations are not due to noise
# Faintly visible unlit segments: standard deviation of their level over the lit one, and its maximum
GHOST, MOST_GHOST = 0.12, 0.3
CLOSE = 7.0  # nats within which further characters of a cell are listed
MOST_LISTED = 300


def lit_segments(text: str) -> int:
    """Return the number of segments that a text lights."""
    return sum(int(LIT[NAMES.index(character)].sum()) for character in text if character in NAMES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Levels of a display's segments.

    Attributes:
        ink, seen: (cells, 7) level and visible share of every segment.
        unlit, noise: (cells,) level of unlit segments, and standard deviation of a level's noise, in every cell.
        lit: level of lit segments.
    """

    ink: Array
    seen: Array
    unlit: Array
    noise: Array
    lit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """One way to read a display: its characters from the first cell to the last (blanks kept) and its log-likelihood."""

    characters: str
    log_likelihood: float


def separate(ink: Array, seen: Array, loops: Array, loop_noise: Array) -> Levels | None:
    """Separate lit from unlit levels (N. Otsu, IEEE SMC 9(1), 1979); None if they do not separate.

    Args:
        ink, seen: (cells, 7) level and visible share of every segment.
        loops, loop_noise: (cells,) mean and spread inside the loops; NaN where they are hidden.
    """
    clear = ink[seen >= LEAST_SEEN]
    # Loops are included because "888" has no unlit segment
    values = np.sort(np.concatenate([clear, loops[np.isfinite(loops)]]))
    if len(clear) < 2 or len(values) < 4:
        return None
    n = np.arange(1, len(values))
    low, high = np.cumsum(values)[:-1] / n, (values.sum() - np.cumsum(values)[:-1]) / (len(values) - n)
    k = int((n * (len(values) - n) * (high - low) ** 2).argmax())
    if high[k] - low[k] < 2.5:
        return None
    known = loop_noise[np.isfinite(loop_noise)]
    spread = np.where(np.isfinite(loop_noise), loop_noise, np.median(known) if len(known) else LEAST_NOISE)
    noise = np.maximum(LEAST_NOISE, LEVEL_NOISE * spread)
    # The best value across a stroke exceeds the mean, so unlit segments appear about one sigma brighter than loops.
    local = np.where(np.isfinite(loops), loops + noise, low[k])
    return Levels(
        ink=ink, seen=seen, unlit=0.5 * (local + np.minimum(low[k], local + 2 * noise)), lit=float(high[k]), noise=noise
    )


def likelihoods(levels: Levels) -> tuple[Array, Array]:
    """Return the log-likelihoods of every character (cells, characters), and of a blank cell (cells,)."""
    weight = np.where(levels.seen >= LEAST_SEEN, np.minimum(1.0, levels.seen * 1.5), 0.0)  # (cells, 7)
    w, ink = weight[:, None, :], levels.ink[:, None, :]
    there = w * LIT
    total = there.sum(axis=2, keepdims=True)
    # Lit level of each cell, shrunk towards the display's level with the weight of one segment.
    own = ((there * ink).sum(axis=2, keepdims=True) + 0.5 * levels.lit) / (total + 0.5)
    unlit, noise = levels.unlit[:, None, None], levels.noise[:, None, None]
    own = np.clip(own, unlit + 0.15 * np.maximum(levels.lit - unlit, 1.0), 2.5 * levels.lit)
    sigma = np.sqrt(noise**2 + (np.where(LIT, SPREAD, LEAK) * own) ** 2)
    miss = (ink - np.where(LIT, own, unlit)) / sigma
    segments = -np.minimum(0.5 * miss**2, MOST_LOSS) - np.log(sigma / levels.lit)
    characters = (w * segments).sum(axis=2) - 0.5 * (np.log(own / levels.lit)[:, :, 0] / CELL_SPREAD) ** 2
    for k, loss in RARE.items():
        characters[:, k] -= loss
    return np.asarray(characters), _blank(levels, weight)


def _blank(levels: Levels, weight: Array) -> Array:
    """Return the log-likelihood (cells,) of a blank cell.

    Its segments have similar levels, which hardly exceed those of its loops.
    """
    unlit, noise = levels.unlit[:, None], levels.noise[:, None]
    ghost = np.sort(np.where(weight > 0, levels.ink, unlit), axis=1)[:, 3:4]  # the median
    ghost = np.clip(ghost, unlit, unlit + MOST_GHOST * levels.lit)
    spread = np.sqrt(noise**2 + (0.5 * LEAK * levels.lit) ** 2)
    loss = np.minimum(0.5 * ((levels.ink - ghost) / spread) ** 2, MOST_LOSS) + np.log(spread / levels.lit)
    return np.asarray(-(weight * loss).sum(axis=1) - 0.5 * ((ghost - unlit)[:, 0] / (GHOST * levels.lit)) ** 2)


def numbers(characters: Array, blank: Array) -> list[Number]:
    """Return every likely number, best first: blanks, an optional sign (and blanks after it), then digits.

    Args:
        characters, blank: from `likelihoods`.
    """
    count = len(blank)
    minus = characters[:, NAMES.index("-")]
    digits = _digits(characters)
    lead = np.concatenate([[0.0], np.cumsum(blank)])
    best_digit = digits.max(axis=1)
    tail = np.concatenate([np.cumsum(best_digit[::-1])[::-1], [0.0]])
    forms: list[tuple[float, int, int]] = []  # total, cells before the first digit, place of the sign or -1
    for first in range(count):
        forms.append((float(lead[first] + tail[first]), first, -1))
        forms += [(float(lead[first] - blank[k] + minus[k] + tail[first]), first, k) for k in range(first)]
    forms.sort(reverse=True)
    listed: list[Number] = []
    for total, first, sign in forms:
        if total < forms[0][0] - CLOSE or len(listed) >= MOST_LISTED:
            break
        prefix = "".join("-" if k == sign else " " for k in range(first))
        listed += [
            Number(characters=prefix + text, log_likelihood=total - loss)
            for text, loss in _alternatives(digits[first:])
        ]
    return sorted(listed, key=lambda n: n.log_likelihood, reverse=True)


def _digits(characters: Array) -> Array:
    """Return the log-likelihood (cells, 10) of every digit in its best form."""
    digits = characters[:, :10].copy()
    for digit, k in OTHER_FORMS:
        np.maximum(digits[:, digit], characters[:, k], out=digits[:, digit])
    return digits


def _alternatives(digits: Array) -> list[tuple[str, float]]:
    """Return the likely strings of digits, each with its difference in nats to the best."""
    losses = digits.max(axis=1, keepdims=True) - digits
    close = [
        sorted(((str(k), loss) for k, loss in enumerate(row) if loss <= CLOSE), key=lambda c: c[1])
        for row in losses.tolist()
    ]
    while prod(len(c) for c in close) > MOST_LISTED:  # drop the least likely character of all
        worst = max(range(len(close)), key=lambda i: close[i][-1][1] if len(close[i]) > 1 else -1.0)
        close[worst].pop()
    texts = [("".join(c for c, _ in choice), sum(loss for _, loss in choice)) for choice in product(*close)]
    return [(text, loss) for text, loss in texts if loss <= CLOSE]
