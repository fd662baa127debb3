"""Finds the numbers printed around a dial, and the scale that they tell: the value at each angle of a pointer.

Pieces of ink of the size of numerals are recognised one by one, and neighbours of one height on one line are a number. A
scale is the largest set of numbers on one ring whose values rise, or fall, evenly with their angles; words, other scales and
misread numbers do not fit it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from hal.arrays import Array, Image
from perception.vision.photographs.printed_characters import LEAST_DIGIT, Characters, characters, inks, is_tall
from perception.vision.photographs.printed_digits import OTHER

RADIUS_PX = 240.0  # of the dial in the picture that is searched
FLAT_AT, OVERLAP_RAD = (
    0.78,
    0.5,
)  # unrolled: distance from the middle whose arcs keep their length, and what is seen twice
RING = (0.3, 1.02)  # distance of numbers from the middle, over the radius
SAME_HEIGHT, LEVEL = 0.3, 0.22  # ratio of heights, and distance from the line, over the height
NEAREST, FARTHEST = -0.12, 0.5  # gap between the characters of a number, over the height
POINT_TALL, POINT_GAP = 0.4, 1.25  # of a decimal point, and of the characters beside one
LETTER_GAP = 0.45  # between a number and a letter of one word, over the height
TORN, SURE_DIGIT = 1.1, 0.6  # gap, over the height, to a digit of this probability which says that a point was not seen
MINUS_TALL, MINUS_WIDE = 0.3, (0.25, 1.1)
MOST_NUMBERS = 60


Place = Callable[[Array, Array], tuple[Array, Array]]
"""Returns angle, clockwise from up, and distance from the middle over the radius, of a place in a picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A printed number.

    Attributes:
        value, text: what it says.
        angle_rad: of its middle seen from the dial's, clockwise from up.
        off: distance of the middles, over the radius.
        height: of its digits, over the radius.
        probability: that all of its digits are right.
    """

    value: float
    text: str
    angle_rad: float
    off: float
    height: float
    probability: float


def find_numbers(gray: Image, u: float, v: float, radius: float) -> list[list[Number]]:
    """Return the numbers on a dial, the likeliest first, in groups that were printed alike.

    The groups are of upright numbers and of those whose tops point outwards, dark and bright ones each.

    Args:
        gray: (H, W) uint8.
        u, v, radius: the dial in it, px.
    """
    face = face_around(gray, u, v, radius)
    return [
        _one_each(_numbers(characters(ink), place))
        for picture, place in ((face, _upright), (_unrolled(face), _radial))
        for ink in inks(picture)
    ]


def _one_each(found: Iterable[Number]) -> list[Number]:
    """Return the likeliest number at each place."""
    kept: list[Number] = []
    for number in sorted(found, key=lambda one: (-len(one.text) * one.probability, one.angle_rad)):
        if len(kept) < MOST_NUMBERS and not any(_same_place(number, other) for other in kept):
            kept.append(number)
    return kept


def _same_place(one: Number, other: Number) -> bool:
    apart = np.hypot(
        one.off * np.sin(one.angle_rad) - other.off * np.sin(other.angle_rad),
        one.off * np.cos(one.angle_rad) - other.off * np.cos(other.angle_rad),
    )
    return bool(apart < 0.5 * max(len(one.text) * one.height, len(other.text) * other.height))


def face_around(gray: Image, u: float, v: float, radius: float) -> Image:
    """Return the square around the dial, with the dial's radius `RADIUS_PX`."""
    scale, half = RADIUS_PX / radius, round(1.05 * RADIUS_PX)
    move = np.array([[scale, 0.0, half - scale * u], [0.0, scale, half - scale * v]])
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.4 / scale) if scale < 0.7 else gray
    return np.asarray(cv2.warpAffine(smooth, move, (2 * half, 2 * half), flags=way, borderMode=cv2.BORDER_REPLICATE))


def _unrolled(face: Image) -> Image:
    """Return the ring of the numbers laid out along a line: numerals whose tops point outwards stand upright there."""
    columns = round((2 * np.pi + OVERLAP_RAD) * FLAT_AT * RADIUS_PX)
    rows = round((RING[1] - RING[0]) * RADIUS_PX)
    angle, off = _radial(np.arange(columns, dtype=float), np.arange(rows, dtype=float)[:, None])
    middle = (len(face) - 1) / 2
    x = middle + RADIUS_PX * off * np.sin(angle)
    y = middle - RADIUS_PX * off * np.cos(angle)
    return np.asarray(cv2.remap(face, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR))


def _upright(x: Array, y: Array) -> tuple[Array, Array]:
    """Return angle, and distance from the middle over the radius, of a place in `face_around`."""
    across, up = x - 1.05 * RADIUS_PX, 1.05 * RADIUS_PX - y
    return np.arctan2(across, up), np.hypot(across, up) / RADIUS_PX


def _radial(x: Array, y: Array) -> tuple[Array, Array]:
    """Return angle, from straight down, and distance from the middle over the radius, of a place in `_unrolled`."""
    return x / (FLAT_AT * RADIUS_PX) - np.pi, RING[1] - y / RADIUS_PX


def _numbers(found: Characters, place: Place) -> Iterator[Number]:
    """Yield the numbers that neighbouring digits make, at their places on the dial."""
    for text, line, probability in rows_of_digits(found):
        angle_rad, off = place(np.array(0.5 * (line.left + line.right)), np.array(line.level))
        if RING[0] < off < RING[1]:
            yield Number(
                value=float(text), text=text, angle_rad=float(angle_rad), off=float(off), height=line.tall / RADIUS_PX,
                probability=probability,
            )  # fmt: skip


def rows_of_digits(found: Characters) -> Iterator[tuple[str, Line, float]]:
    """Yield text, room and probability of the numbers that neighbouring digits make.

    Those that are part of a word, or have lost a point, are left out.
    """
    likely = found.kinds[:, :OTHER].max(axis=1, initial=0.0)
    digits = found.kinds[:, :OTHER].argmax(axis=1)
    used: set[int] = set()
    for first in np.argsort(found.boxes[:, 0], kind="stable"):
        if likely[first] <= LEAST_DIGIT or int(first) in used:
            continue
        row, points = _row(found.boxes, int(first), likely > LEAST_DIGIT)
        used.update(row)
        text = "".join("." * (k in points) + str(digits[one]) for k, one in enumerate(row))
        has_lost_point = text[0] == "0" and len(text) > 1 and text[1] != "."
        line = Line.of(found.boxes[row])
        if len(points) > 1 or has_lost_point or _is_part(found.boxes, likely, line):
            continue
        yield "-" * _has_minus(found.boxes, line) + text, line, float(np.prod(likely[row]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """The room of a number, px: its left and right end, the middle of its height, and its height."""

    left: float
    right: float
    level: float
    tall: float

    @staticmethod
    def of(boxes: Array) -> Line:
        x, y, w, h = boxes.T
        return Line(
            left=float(x[0]), right=float(x[-1] + w[-1]), level=float(np.mean(y + h / 2)), tall=float(np.median(h))
        )


def _row(boxes: Array, first: int, is_digit: Array) -> tuple[list[int], list[int]]:
    """Return the digits of a number from its first one on, and before which of them a decimal point stands."""
    row, points = [first], list[int]()
    while (following := _following(boxes, row[-1], is_digit)) is not None:
        after, has_point = following
        if has_point:
            points.append(len(row))
        row.append(after)
    return row, points


def _is_part(boxes: Array, likely: Array, line: Line) -> bool:
    """Return whether a letter stands beside a number, or a digit so near that a point between them was not seen."""
    x, y, w, h = boxes.T
    off_level, gap = np.abs(y + h / 2 - line.level), np.maximum(x - line.right, line.left - x - w) / line.tall
    is_letter = (likely <= LEAST_DIGIT) & is_tall(boxes) & (h > 0.6 * line.tall) & (h < 1.5 * line.tall)
    is_digit = (likely > SURE_DIGIT) & (np.abs(h - line.tall) < SAME_HEIGHT * line.tall)
    beside = is_letter & (off_level < 0.5 * line.tall) & (gap > -0.1) & (gap < LETTER_GAP)
    torn = is_digit & (off_level < LEVEL * line.tall) & (gap > 0.0) & (gap < TORN)
    return bool((beside | torn).any())


def _following(boxes: Array, last: int, is_digit: Array) -> tuple[int, bool] | None:
    """Return the digit that follows one on its line, and whether a decimal point stands between them; None at the end."""
    x, y, w, h = boxes.T
    tall = h[last]
    gap = (x - x[last] - w[last]) / tall
    level = np.abs(y + h / 2 - y[last] - tall / 2) < LEVEL * tall
    alike = is_digit & level & (np.abs(h - tall) < SAME_HEIGHT * tall) & (gap > NEAREST) & (x > x[last])
    if not alike.any():
        return None
    after = int(np.flatnonzero(alike)[gap[alike].argmin()])
    small = (h < POINT_TALL * tall) & (w < POINT_TALL * tall) & (np.abs(y + h - y[last] - tall) < LEVEL * tall)
    between = small & (x > x[last] + 0.7 * w[last]) & (x + w < x[after] + 0.3 * w[after])
    if between.any():
        return (after, True) if gap[after] < POINT_GAP else None
    return (after, False) if gap[after] < FARTHEST else None


def _has_minus(boxes: Array, line: Line) -> bool:
    """Return whether a short bar stands before a number."""
    x, y, w, h = boxes.T
    is_bar = (h < MINUS_TALL * line.tall) & (w > MINUS_WIDE[0] * line.tall) & (w < MINUS_WIDE[1] * line.tall)
    gap = (line.left - x - w) / line.tall
    is_before = (np.abs(y + h / 2 - line.level) < 0.2 * line.tall) & (gap > -0.1) & (gap < 0.5)
    return bool((is_bar & (w > 1.5 * h) & is_before).any())
