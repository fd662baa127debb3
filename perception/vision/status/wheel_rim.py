"""What the rim of a handwheel tells: the colour of the unmarked parts, and where the wheel's middle is in the patch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.panel import Handwheel
from perception.vision.patch import Patch
from perception.vision.status.pointer import unroll

DIRECTIONS = 72
NEAR = 0.18  # share of the radius within which the rim's edge is searched
EDGE = 4  # samples between the two whose difference is the slope of the gray
STRONG = 0.5  # share of the usual slope; weaker edges are hidden
KEPT = 2.5  # times the usual residual; farther edges are of something else
LEAST_KEPT = 0.6  # share of the directions that must agree
ROUNDS = 4


def rim_gray(patch: Patch, spec: Handwheel, angles_rad: Array) -> float:
    """Return the usual gray of the rim."""
    radii_m = spec.radius_m + spec.rim_m * np.linspace(-0.5, 0.5, 5)
    return float(np.median(unroll(patch, (0.0, 0.0), radii_m, angles_rad)))


def unlike(mark: NDArray[np.float32], step: int, gray: float) -> float:
    """Return the largest difference (gray levels) of a spoke from a gray that holds at two neighbouring radii."""
    difference = np.abs(mark[:, (step + np.arange(-3, 4)) % mark.shape[1]].mean(axis=1) - gray)
    return float(np.minimum(difference[:-1], difference[1:]).max())


def middle_of(patch: Patch, radius_m: float) -> tuple[float, float]:
    """Return the middle (m) of a circle of about this radius whose edge is visible, or (0, 0) where there is none."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    radii = np.linspace(1.0 - NEAR, 1.0 + NEAR, 73) * radius_m
    gray = np.asarray(unroll(patch, (0.0, 0.0), radii, angles), float)
    third = len(radii) // 3
    slope = (gray[EDGE:] - gray[:-EDGE]) * np.sign(np.median(gray[-third:]) - np.median(gray[:third]))
    edges = (0.5 * (radii[EDGE:] + radii[:-EDGE]))[slope.argmax(axis=0)]
    strength = slope.max(axis=0)
    kept = strength > STRONG * np.median(strength)
    J = np.column_stack([np.ones(DIRECTIONS), np.sin(angles), np.cos(angles)])
    circle = np.zeros(3)
    for _ in range(ROUNDS):
        if kept.sum() < LEAST_KEPT * DIRECTIONS:
            return 0.0, 0.0
        circle = np.linalg.lstsq(J[kept], edges[kept], rcond=None)[0]
        off = np.abs(edges - J @ circle)
        kept = off < max(0.02 * radius_m, KEPT * float(np.median(off[kept])))
    return float(circle[1]), float(circle[2])
