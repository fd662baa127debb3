"""Separation of a lit lamp from its own glow on the plate, which the difference image also shows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

LEVELS = np.linspace(0.25, 0.9, 9)  # tried levels, as shares of the brightest part
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
    """Return the part of a brighter region that has the steepest edge; None if there is none.

    The region above a level shrinks as the level rises; where it shrinks least per rise, there is an edge. Glow
    decreases slowly, so its outlines have no edge. Near the edge, pixels count by how far they stand out of the glow.

    Args:
        rise: (H, W) difference of on and off around one region.
        seed: (H, W) the region's pixels that stand out of the noise.
    """
    peak = level_at(rise[seed], 0.99)
    level = _steepest_level(rise, seed, peak)
    body = _component(rise, seed, level)
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


def _steepest_level(rise: Image, seed: Mask, peak: float) -> float:
    """Return the level, midway between two neighbouring ones, across which the region's mean radius changes least."""
    radii = []
    for share in LEVELS:
        body = _component(rise, seed, share * peak)
        radii.append(np.sqrt(float(body.sum()) / np.pi) if body is not None else 0.0)
    shrink = -np.diff(radii)
    alive = np.array(radii[1:]) > 1.0
    if not alive.any():
        return float(0.5 * peak)
    # Neighbouring steps are averaged, because a single step of a small lamp's radius is dominated by sampling.
    kernel = [0.5, 1.0, 0.5]
    smooth = np.convolve(shrink, kernel, mode="same") / np.convolve(np.ones_like(shrink), kernel, mode="same")
    best = int(np.argmin(np.where(alive, smooth, np.inf)))
    return float(0.5 * (LEVELS[best] + LEVELS[best + 1]) * peak)


def _component(rise: Image, seed: Mask, level: float) -> NDArray[np.uint8] | None:
    """Return the 4-connected part above the level that shares most pixels with the seed; None if none does."""
    lit = (rise > level).astype(np.uint8)
    _, labels = cv2.connectedComponents(lit, connectivity=4)
    touched = np.bincount(labels[seed & (lit > 0)], minlength=1)
    touched[0] = 0
    if not touched.any():
        return None
    return np.asarray(labels == int(np.argmax(touched)), np.uint8)
