"""What spoils a drawn image: light, blur, noise, glare and cables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbance:
    """Disturbances of an image; none by default."""

    exposure: float = 1.0
    slope_ratio: float = 1.0
    blur_sigma_px: float = 0.4
    noise_sigma: float = 1.5
    glare: tuple[tuple[float, float, float], ...] = ()
    cables: tuple[tuple[float, float, float, float, float], ...] = ()
    seed: int = 0
    lights: Mapping[str, float] = field(default_factory=dict)


def disturbed(image: NDArray[np.float32], d: Disturbance) -> NDArray[np.uint8]:
    """Apply light, lens, glare, cables, exposure and noise to a clean gray image."""
    height, width = image.shape
    x = np.linspace(-1, 1, width)
    light = np.exp(0.5 * np.log(d.slope_ratio) * x)[None, :].astype(np.float32)
    picture = image * light * d.exposure
    v, u = np.mgrid[:height, :width]
    for cu, cv, radius in d.glare:
        picture = picture + 400.0 * np.exp(-((u - cu) ** 2 + (v - cv) ** 2) / (2 * (radius / 2) ** 2)).astype(
            np.float32
        )
    for u0, v0, u1, v1, thick in d.cables:
        cv2.line(picture, (round(u0), round(v0)), (round(u1), round(v1)), 25.0, max(1, round(thick)), cv2.LINE_AA)
    if d.blur_sigma_px > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), d.blur_sigma_px)
    noise = np.random.default_rng(d.seed).normal(0.0, d.noise_sigma, picture.shape)
    return np.asarray(np.clip(np.round(picture + noise), 0, 255), np.uint8)
