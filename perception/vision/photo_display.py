"""Seven-segment displays in photographs: a crop, or a scene in which the display must be found first."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.digit_search import DigitRow, find_digit_rows
from perception.vision.image import Image, as_gray
from perception.vision.reading import Status, refused
from perception.vision.status.display import read_window

DIGIT_WINDOW_PX = 64
SCENE_PX = 640  # larger sides are reduced to this for the search
ROWS_TRIED = 4
ROOM_ABOVE, ROOM_BESIDE = 0.5, 1.2  # round a row's cells, over the digit height
FRAME = 0.08  # of a crop's height that a frame may take


def read_photograph(image: NDArray[Any], *, scene: bool) -> Status:
    """Text of the display in a photograph.

    Args:
        image: gray or RGB uint8.
        scene: False when the image is cropped to the display.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    gray = as_gray(image)
    answers = [
        read_window(_scaled(window), digits=None, decimals=None, dark=dark)
        for window, dark in (_rows(gray) if scene else _crops(gray))
    ]
    sure = [answer for answer in answers if answer.answered]
    if sure or answers:
        return max(sure or answers, key=lambda answer: answer.confidence)
    return refused("no display is found in the picture: crop it, or come closer")


def _crops(gray: Image) -> list[tuple[Image, bool | None]]:
    """The whole crop, and the window inside its frame."""
    inset = round(FRAME * len(gray))
    inner = gray[inset : gray.shape[0] - inset, inset : gray.shape[1] - inset]
    return [(gray, None), (inner, None)] if min(gray.shape) > 4 * inset + 24 else [(gray, None)]


def _rows(gray: Image) -> list[tuple[Image, bool | None]]:
    """The likeliest rows of digits in a scene, with a little room round them, and their polarity."""
    scale = min(1.0, SCENE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    found = [(_window(gray, row, scale), row.is_dark) for row in find_digit_rows(np.asarray(small, np.uint8))]
    return [(window, dark) for window, dark in found[:ROWS_TRIED] if min(window.shape) >= 12]


def _window(gray: Image, row: DigitRow, scale: float) -> Image:
    above, beside = ROOM_ABOVE * row.height, ROOM_BESIDE * row.height
    x0, x1 = (max(0, round(x / scale)) for x in (row.left - beside, row.right + beside))
    y0, y1 = (max(0, round(y / scale)) for y in (row.top - above, row.bottom + above))
    return gray[y0:y1, x0:x1]


def _scaled(window: Image) -> Image:
    factor = DIGIT_WINDOW_PX / window.shape[0]
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(window, None, fx=factor, fy=factor, interpolation=how), np.uint8)
