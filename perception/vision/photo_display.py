"""Seven-segment displays in photographs: a crop, or a scene in which the display must be found first."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.image import Image, as_gray
from perception.vision.reading import Status, refused
from perception.vision.shapes import direction_maps, find_edges, find_rectangles
from perception.vision.status.display import read_window

DIGIT_WINDOW_PX = 64
SCENE_WIDTH_PX = 640
WINDOWS_TRIED = 6
LEAST_ASPECT, MOST_ASPECT = 1.1, 7.0


def read_photograph(image: NDArray[Any], *, scene: bool) -> Status:
    """Text of the display in a photograph.

    Args:
        image: gray or RGB uint8.
        scene: False when the image is cropped to the display.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    gray = as_gray(image)
    answers = [read_window(_scaled(window), digits=None, decimals=None, dark=None) for window in _windows(gray, scene)]
    sure = [answer for answer in answers if answer.answered]
    if sure:
        return max(sure, key=lambda answer: answer.confidence)
    if answers:
        return max(answers, key=lambda answer: answer.confidence)
    return refused("no display is found in the picture: crop it, or come closer")


def _windows(gray: Image, scene: bool) -> list[Image]:
    """The whole crop and the window inside its frame, or the likeliest rectangles of a scene."""
    height, width = gray.shape
    if not scene:
        inset = round(0.08 * height)
        return (
            [gray, gray[inset : height - inset, inset : width - inset]]
            if min(height, width) > 4 * inset + 24
            else [gray]
        )
    scale = min(1.0, SCENE_WIDTH_PX / width)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    found = [
        r
        for r in find_rectangles(
            direction_maps(find_edges(np.asarray(small, np.uint8))), least_px=18.0, most_px=0.95 * max(small.shape)
        )
        if LEAST_ASPECT <= r.width / max(r.height, 1.0) <= MOST_ASPECT
    ]
    out = []
    for r in sorted(found, key=lambda r: r.coverage * np.sqrt(r.width * r.height), reverse=True)[:WINDOWS_TRIED]:
        x0, x1 = (round((r.u + s * 0.47 * r.width) / scale) for s in (-1, 1))
        y0, y1 = (round((r.v + s * 0.45 * r.height) / scale) for s in (-1, 1))
        window = gray[max(0, y0) : y1, max(0, x0) : x1]
        if min(window.shape) >= 12:
            out.append(window)
    return out


def _scaled(window: Image) -> Image:
    factor = DIGIT_WINDOW_PX / window.shape[0]
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(window, None, fx=factor, fy=factor, interpolation=how), np.uint8)
