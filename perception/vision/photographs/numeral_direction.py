"""Whether the numerals 0 to 9 around a dial run clockwise or counter-clockwise, by comparison with drawn digits."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image

FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX)
HEIGHTS = (0.12, 0.15, 0.19, 0.24)  # of a numeral, shares of the dial's radius
RING, HALF = 0.66, 0.27  # shares of the radius: where numerals stand, and half the side of the searched square
DRAWN_PX = 40
COUNT = 10
LEAST_ALIKE = 0.45  # mean correlation with the digits of a direction, below which they are not legible
LEAST_LEAD = 0.05  # of that direction over the other


def numerals_run(gray: Image, u: float, v: float, radius: float) -> int:
    """Return 1 if the numerals of a full turn from 0 at the top run clockwise, -1 if the other way, 0 if illegible.

    Args:
        gray: (H, W) uint8; the numerals are upright.
        u, v, radius: the dial in it, px.
    """
    clockwise, counter = evidence(gray, u, v, radius)
    if max(clockwise, counter) < LEAST_ALIKE or abs(clockwise - counter) < LEAST_LEAD:
        return 0
    return 1 if clockwise > counter else -1


def evidence(gray: Image, u: float, v: float, radius: float) -> tuple[float, float]:
    """Return the mean correlations with the digits at their places, clockwise and counter-clockwise.

    They are those of the font, the size and the polarity that suit either direction best.
    """
    places = [k for k in range(COUNT) if k not in (0, COUNT // 2)]  # 0 and 5 are the same either way
    squares = [_square(gray, u, v, radius, 2 * np.pi * k / COUNT) for k in places]
    best = (0.0, 0.0)
    for font in FONTS:
        for height in HEIGHTS:
            size = round(height * radius)
            if size < 5:
                continue
            alike = np.array([[_alike(square, _digit(font, d, size)) for d in range(COUNT)] for square in squares])
            for peaks in (alike[:, :, 0], alike[:, :, 1]):
                found = tuple(
                    float(np.mean([peaks[i, way * k % COUNT] for i, k in enumerate(places)])) for way in (1, -1)
                )
                if max(found) > max(best):
                    best = (found[0], found[1])
    return best


def _square(gray: Image, u: float, v: float, radius: float, angle_rad: float) -> NDArray[np.float32]:
    """Return the upright square around the place of a numeral."""
    x, y = u + RING * radius * np.sin(angle_rad), v - RING * radius * np.cos(angle_rad)
    side = 2 * round(HALF * radius) + 1
    return np.asarray(cv2.getRectSubPix(gray, (side, side), (float(x), float(y))), np.float32)


def _alike(square: NDArray[np.float32], digit: NDArray[np.float32]) -> Array:
    """Return the greatest correlation of a digit in the square, as bright and as dark ink."""
    if digit.shape[0] > square.shape[0] or digit.shape[1] > square.shape[1]:
        return np.zeros(2)
    found = cv2.matchTemplate(square, digit, cv2.TM_CCOEFF_NORMED)
    return np.array([float(found.max()), -float(found.min())])


@cache
def _digit(font: int, digit: int, height_px: int) -> NDArray[np.float32]:
    """Return a bright digit of that height on black, with a narrow margin."""
    scale = cv2.getFontScaleFromHeight(font, DRAWN_PX, 4)
    (width, high), _ = cv2.getTextSize(str(digit), font, scale, 4)
    room = 8
    canvas = np.zeros((high + 2 * room, width + 2 * room), np.uint8)
    cv2.putText(canvas, str(digit), (room, room + high), font, scale, 255, 4, cv2.LINE_AA)
    factor = height_px / high
    small = cv2.resize(canvas, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.8), np.float32)
