"""Draws a range image with one colour per surface and with the objects that were found in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.range import RangeScene, picture
from service.report.plots import box_of

Pixels = NDArray[np.uint8]
FOUND, LOST = (40, 220, 60), (255, 60, 60)
TEXT_SCALE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mark:
    """An object to draw over the image; `outline_px` is (N, 2) in pixels of the range image."""

    outline_px: Array
    text: str
    is_found: bool


def surfaces_picture(scene: RangeScene, marks: Sequence[Mark]) -> Pixels:
    """Return a picture (sH, sW, 3) RGB of the surfaces with the marks: green for found objects, red for missing ones."""
    image = np.ascontiguousarray(picture(scene))
    scale = image.shape[0] // scene.labels.shape[0]
    for mark in marks:
        colour = FOUND if mark.is_found else LOST
        # The centre of a pixel of the range image maps to the centre of its block in the picture.
        outline = np.round(scale * (mark.outline_px + 0.5) - 0.5).astype(np.int32)
        cv2.polylines(image, [outline.reshape(-1, 1, 2)], True, colour, 2, cv2.LINE_AA)
        _write(image, mark.text, outline, colour)
    rows, columns = _panel_in(scene, marks)
    enlarged = [
        slice(scale * (one.start or 0), None if one.stop is None else scale * one.stop) for one in (rows, columns)
    ]
    return np.asarray(image[enlarged[0], enlarged[1]], np.uint8)


def _panel_in(scene: RangeScene, marks: Sequence[Mark]) -> tuple[slice, slice]:
    """Return the rows and columns of the surface that is most often around the objects, which is the plate."""
    around: Counter[int] = Counter()
    for mark in marks:
        low, high = (
            np.floor(mark.outline_px.min(axis=0) - 4).astype(int),
            np.ceil(mark.outline_px.max(axis=0) + 5).astype(int),
        )
        around.update(scene.labels[max(0, low[1]) : max(0, high[1]), max(0, low[0]) : max(0, high[0])].ravel().tolist())
    around.pop(0, None)
    return box_of(scene.labels == max(around, key=around.__getitem__, default=0))


def _write(image: Pixels, text: str, outline: NDArray[np.int32], colour: tuple[int, int, int]) -> None:
    """Write text below the outline, or above it when there is no room below, inside the image."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, TEXT_SCALE, 1)
    low, high = outline.min(axis=0), outline.max(axis=0)
    x = int(np.clip(low[0], 2, max(2, image.shape[1] - width - 2)))
    y = int(high[1]) + height + 6
    if y > image.shape[0] - 4:
        y = max(int(low[1]) - 6, height + 2)
    for ink, thickness in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, TEXT_SCALE, ink, thickness, cv2.LINE_AA)
