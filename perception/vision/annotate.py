"""Readings drawn into the image for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.vision.image import Image, check_image
from perception.vision.reading import ObjectReading

GREEN, AMBER, RED = (40, 220, 60), (255, 190, 0), (255, 60, 60)


def draw_annotated(image: NDArray[Any], readings: Iterable[ObjectReading]) -> Image:
    """RGB uint8 (H, W, 3): outlines and readings; green read, amber refused, red not there.

    Args:
        image: gray or RGB uint8; not changed.
    """
    check_image(image)
    rgb = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image[:, :, :3].copy()
    picture: Image = np.ascontiguousarray(rgb)
    scale = max(0.4, picture.shape[1] / 1600)
    for reading in readings:
        if not np.isfinite(reading.outline_px).all():
            continue
        colour = GREEN if reading.answered else AMBER if reading.present else RED
        contour = np.round(reading.outline_px).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [contour], True, colour, max(1, round(scale)), cv2.LINE_AA)
        x, y, _, _ = cv2.boundingRect(contour)
        _label(picture, f"{reading.name}: {said(reading)}", (x, y - 4), colour, scale)
    return picture


def said(reading: ObjectReading) -> str:
    """What the object says, in a few words."""
    if not reading.present:
        return "not seen"
    if reading.reason is not None:
        return "cannot tell"
    if reading.text is not None:
        return f"{reading.text} {reading.unit}".strip()
    if reading.state is not None:
        return reading.state
    return f"{reading.value:.4g} {reading.unit}".strip()


def _label(picture: Image, text: str, corner: tuple[int, int], colour: tuple[int, int, int], scale: float) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x = int(np.clip(corner[0], 0, max(0, picture.shape[1] - width)))
    y = int(np.clip(corner[1], height + 1, picture.shape[0] - 2))
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
