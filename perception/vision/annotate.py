"""Drawing of readings into an image for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.image import check_image
from perception.vision.labels import PixelBox, place_labels
from perception.vision.reading import ObjectReading

FONT = cv2.FONT_HERSHEY_SIMPLEX
RIM = 3  # width of text with its dark rim, which keeps bright text readable on a bright panel
GREEN, AMBER, RED = (40, 220, 60), (255, 190, 0), (255, 60, 60)
Colour = tuple[int, int, int]


def draw_annotated(image: NDArray[Any], readings: Iterable[ObjectReading]) -> Image:
    """Return an RGB uint8 image (H, W, 3) with outlines and readings: green is read, amber refused, red not present.

    Args:
        image: gray or RGB uint8; not changed.
    """
    drawn = [reading for reading in readings if np.isfinite(reading.outline_px).all()]
    texts = [f"{reading.name}: {said(reading)}" for reading in drawn]
    colours = [GREEN if reading.answered else AMBER if reading.present else RED for reading in drawn]
    return _draw(image, [reading.outline_px for reading in drawn], texts, colours)


def draw_outlines(
    image: NDArray[Any], outlines_px: Sequence[NDArray[Any]], texts: Sequence[str], is_sure: Sequence[bool]
) -> Image:
    """Return an RGB uint8 image (H, W, 3) with closed outlines, (N, 2) px each, and a text beside each of them.

    Outlines are green where `is_sure`, else amber.
    """
    return _draw(image, outlines_px, texts, [GREEN if sure else AMBER for sure in is_sure])


def _draw(
    image: NDArray[Any], outlines_px: Sequence[NDArray[Any]], texts: Sequence[str], colours: Sequence[Colour]
) -> Image:
    """Draw outlines and texts so that no text covers another."""
    check_image(image)
    rgb = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image[:, :, :3].copy()
    picture: Image = np.ascontiguousarray(rgb)
    scale = max(0.4, picture.shape[1] / 1600)
    contours = [np.round(outline).astype(np.int32).reshape(-1, 1, 2) for outline in outlines_px]
    labels = place_labels(
        [PixelBox(*cv2.boundingRect(contour)) for contour in contours],
        [_size(text, scale) for text in texts],
        (picture.shape[1], picture.shape[0]),
    )
    for contour, colour in zip(contours, colours, strict=True):
        cv2.polylines(picture, [contour], True, colour, max(1, round(scale)), cv2.LINE_AA)
    for text, label, colour in zip(texts, labels, colours, strict=True):
        _write(picture, text, label, colour, scale)
    return picture


def said(reading: ObjectReading) -> str:
    """Return a short text of an object's reading."""
    if not reading.present:
        return "not seen"
    if reading.reason is not None:
        return "cannot tell"
    if reading.text is not None:
        return f"{reading.text} {reading.unit}".strip()
    if reading.state is not None:
        return reading.state
    return f"{reading.value:.4g} {reading.unit}".strip()


def _size(text: str, scale: float) -> tuple[int, int]:
    """Return width and height of the text in pixels, with its rim and the parts below the line."""
    (width, height), below = cv2.getTextSize(text, FONT, scale, RIM)
    return width + RIM, height + below


def _write(picture: Image, text: str, place: PixelBox, colour: Colour, scale: float) -> None:
    """Write a text into its box, with a dark rim."""
    _, below = cv2.getTextSize(text, FONT, scale, RIM)
    foot = (place.x + RIM // 2, place.y + place.height - below)
    cv2.putText(picture, text, foot, FONT, scale, (0, 0, 0), RIM, cv2.LINE_AA)
    cv2.putText(picture, text, foot, FONT, scale, colour, 1, cv2.LINE_AA)
