"""What the picture of an object looks like, and the range of that in the judged cases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

GLARE_LEVEL = 250
MARGIN = 0.02  # of the range: a picture this close to the judged ones is like them


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """Measures of a picture.

    Attributes:
        sharpness: strong slopes of the gray level relative to the contrast, per pixel; falls with blur.
        contrast: gray levels between the 5 % and the 95 % quantile.
        brightness: median gray level.
        glare: share of the pixels that are saturated.
        size_px: side of a square of the same area.
    """

    sharpness: float
    contrast: float
    brightness: float
    glare: float
    size_px: float


NAMES = tuple(field.name for field in fields(Features))


def features_of(png: bytes) -> Features | None:
    """Return the measures of a picture; None if it cannot be read."""
    import cv2  # a second of the start of the service, which needs it for judged pictures only

    gray = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if gray is None or min(gray.shape) < 3:
        return None
    level = gray.astype(np.float32)
    low, high = np.quantile(level, (0.05, 0.95))
    slopes = np.hypot(cv2.Sobel(level, cv2.CV_32F, 1, 0), cv2.Sobel(level, cv2.CV_32F, 0, 1)) / 8.0
    contrast = float(high - low)
    return Features(
        sharpness=float(np.quantile(slopes, 0.98)) / max(contrast, 1.0),
        contrast=contrast,
        brightness=float(np.median(level)),
        glare=float(np.mean(gray >= GLARE_LEVEL)),
        size_px=float(np.sqrt(gray.size)),
    )


def box_of(cases: Sequence[Features]) -> dict[str, tuple[float, float]]:
    """Return the least and the greatest of each measure among judged cases."""
    return {name: (min(values), max(values)) for name in NAMES if (values := [getattr(one, name) for one in cases])}


def outside(box: dict[str, tuple[float, float]], features: Features) -> str:
    """Return in what a picture differs from the judged ones, as a sentence; empty if it is like them."""
    told = []
    for name, (low, high) in box.items():
        value, margin = getattr(features, name), MARGIN * (high - low)
        if not low - margin <= value <= high + margin:
            told.append(f"{name.removesuffix('_px')} {value:.3g} instead of {low:.3g} to {high:.3g}")
    return f"its picture is not like those of the judged cases: {', '.join(told)}" if told else ""
