"""Separation of a lit lamp from its own glow on the plate, which the difference image also shows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

RAMP = 0.5  # share of the step from glow to lamp over which pixels are counted in part
RING_PX = 2  # half width of a lamp's edge, because of blur and sampling


def level_at(values: NDArray[np.float32], share: float) -> float:
    """Return the value below which `share` of the values (n,) lie; 20 times as fast as numpy's quantile for so few."""
    place = round(share * (len(values) - 1))
    return float(np.partition(values, place)[place])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Core:
    """The lamp: weights 0 to 1 of its pixels, its level, and the level of the glow around it."""

    weights: Image
    top: float
    glow: float


def lamp_core(rise: Image, seed: Mask) -> Core | None:
    """Return the part of a brighter region above half of its peak; None if there is none.

    Near the edge, pixels count by how far they stand out of the glow.

    Args:
        rise: (H, W) difference of on and off around one region.
        seed: (H, W) the region's pixels that stand out of the noise.
    """
    body = _component(rise, seed, 0.5 * level_at(rise[seed], 0.99))
    if body is None:
        return None
    kernel = np.ones((3, 3), np.uint8)
    inside = cv2.erode(body, kernel) > 0
    top = level_at(rise[inside if inside.any() else body > 0], 0.5)
    reach = cv2.dilate(body, kernel, iterations=RING_PX)
    ring = (cv2.dilate(reach, kernel) > 0) & (reach == 0)
    glow = min(level_at(rise[ring], 0.5), 0.9 * top) if ring.any() else 0.0
    # The edge is half way between lamp and glow. A ramp across it counts partly covered pixels by their share, and
    # unevenness of the glow (cut off at the plate's edge) or of the lamp (a highlight when off) has no effect.
    share = np.clip(0.5 + (rise - 0.5 * (top + glow)) / max(RAMP * (top - glow), 1e-3), 0.0, 1.0)
    weights = np.where(reach > 0, share, 0.0).astype(np.float32)
    return Core(weights=weights, top=top, glow=glow)


def _component(rise: Image, seed: Mask, level: float) -> NDArray[np.uint8] | None:
    """Return the 4-connected part above the level that shares most pixels with the seed; None if none does."""
    lit = (rise > level).astype(np.uint8)
    _, labels = cv2.connectedComponents(lit, connectivity=4)
    touched = np.bincount(labels[seed & (lit > 0)], minlength=1)
    touched[0] = 0
    if not touched.any():
        return None
    return np.asarray(labels == int(np.argmax(touched)), np.uint8)
