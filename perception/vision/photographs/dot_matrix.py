"""Reader of displays whose characters are drawn with dots, 5 x 7 of them as a rule.

In a picture that is smoothed by half of the dots' distance and reduced until a character is `TALL_PX` high, the dots of a
stroke merge. The characters are then recognised like printed ones. In a scene, where numbers may be printed, a number has
to fall apart into dots at the picture's own size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Image
from perception.vision.photographs.numerals import rows_of_digits
from perception.vision.photographs.printed_characters import characters, inks
from perception.vision.reading import PatchReading

TALL_PX = 18.0  # of a character where its dots merge
SMOOTHED = 0.5  # of the distance between dots
DOTS_HIGH = 7
LEAST_PX, MOST_SHARE, STEP = (
    18.0,
    0.9,
    1.2,
)  # heights of characters that are tried: the least, the most over the picture's
NEARLY = 1.35  # ratio to the tried height of a character that counts
LEAST_CHARACTERS = 2
FILLED = (0.3, 0.4)  # least shares of the height and of the width of a picture that is cropped to a display
DOTS = 6  # least number of dots of a digit; a 1 has eight or more
RIVAL = 0.5  # weight of other texts that were read in the same place


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """A row of digits: text, box in the picture (px), whether its ink is dark, and probability."""

    text: str
    left: float
    top: float
    right: float
    bottom: float
    is_dark: bool
    probability: float


def read_dots(gray: Image, *, is_scene: bool) -> PatchReading | None:
    """Return the reading of the clearest number of dots in a picture; None if there is none.

    Args:
        gray: (H, W) uint8.
        is_scene: whether the display is somewhere in the picture, where printed numbers may be, too.
    """
    rows = [row for row in _rows(gray) if (not is_scene and _fills(gray, row)) or _is_of_dots(gray, row)]
    best = max((_told(row.text, rows) for row in rows), key=lambda one: one[0], default=None)
    if best is None:
        return None
    _, text, confidence = best
    return PatchReading(value=float(text), text=text, confidence=confidence)


def _told(text: str, rows: Sequence[_Row]) -> tuple[float, str, float]:
    """Return the weight of a text, the text, and its confidence.

    What was read as a part of it, such as the number without its minus, speaks for the text and against its being sure.
    """
    own = [row for row in rows if row.text == text]
    surest = max(own, key=lambda row: row.probability)
    beside = [row for row in rows if row.text != text and _share_place(row, surest)]
    of_own = sum(row.probability for row in own)
    of_parts = sum(row.probability * len(row.text) / len(text) for row in beside if row.text in text)
    of_others = sum(row.probability for row in beside if row.text not in text)
    agreed = (of_own + 0.5 * of_parts) / (of_own + of_parts + RIVAL * of_others)
    return len(text) * (of_own + of_parts), text, surest.probability * agreed


def _rows(gray: Image) -> Iterator[_Row]:
    """Yield the rows of digits of all tried heights."""
    height = LEAST_PX
    while height <= MOST_SHARE * gray.shape[0]:
        scale = TALL_PX / height
        smooth = cv2.GaussianBlur(gray, (0, 0), SMOOTHED * height / DOTS_HIGH)
        small = np.asarray(cv2.resize(smooth, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        for ink, is_dark in zip(inks(small), (True, False), strict=True):
            for text, line, probability in rows_of_digits(characters(ink)):
                if len(text) >= LEAST_CHARACTERS and TALL_PX / NEARLY < line.tall < TALL_PX * NEARLY:
                    top = line.level - 0.5 * line.tall
                    yield _Row(
                        text=text, left=line.left / scale, top=top / scale, right=line.right / scale,
                        bottom=(top + line.tall) / scale, is_dark=is_dark, probability=probability,
                    )  # fmt: skip
        height *= STEP


def _fills(gray: Image, row: _Row) -> bool:
    """Return whether a row is as large as the only text of a picture that is cropped to it."""
    high, wide = (row.bottom - row.top) / gray.shape[0], (row.right - row.left) / gray.shape[1]
    return bool(high > FILLED[0] and wide > FILLED[1])


def _is_of_dots(gray: Image, row: _Row) -> bool:
    """Return whether the ink of a row falls apart into dots at the picture's own size."""
    height = row.bottom - row.top
    room = 0.15 * height
    top, left = (max(0, round(edge - room)) for edge in (row.top, row.left))
    part = gray[top : round(row.bottom + room), left : round(row.right + room)]
    side = 2 * max(3, round(height / DOTS_HIGH)) + 1
    way = cv2.MORPH_BLACKHAT if row.is_dark else cv2.MORPH_TOPHAT
    ink = cv2.morphologyEx(part, way, np.ones((side, side), np.uint8))
    is_ink = (ink > 0.5 * np.quantile(ink, 0.97)).astype(np.uint8)
    _, _, boxes, _ = cv2.connectedComponentsWithStats(is_ink, connectivity=4)
    wide, tall = boxes[1:, cv2.CC_STAT_WIDTH], boxes[1:, cv2.CC_STAT_HEIGHT]
    is_dot = (np.maximum(wide, tall) < height / 4.0) & (np.minimum(wide, tall) > height / 25.0)
    return int(is_dot.sum()) >= DOTS * sum(character.isdigit() for character in row.text)


def _share_place(one: _Row, other: _Row) -> bool:
    """Return whether two rows cover each other."""
    return one.left < other.right and other.left < one.right and one.top < other.bottom and other.top < one.bottom
