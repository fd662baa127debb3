"""Reader of selector knobs: the mark on the knob points at one of the taught places."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.panel import Rotary
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise
from perception.vision.status.reader import Reader

MARK_FROM, MARK_TO = 0.35, 0.80  # share of the knob's radius over which the mark runs
MARK_HALF_WIDTH = 0.06
WOBBLE_RAD = np.deg2rad(np.linspace(-9, 9, 7))  # tried deviations of a detent from its nominal angle


def read_rotary(patch: Patch, spec: Rotary) -> PatchReading:
    """Return the state of a selector. `patch` shows the plane of the knob's face."""
    angles = np.array([state.angle_rad for state in spec.states])
    contrast, seen = mark_contrast(patch, spec.radius_m, (angles[:, None] + WOBBLE_RAD).ravel())
    evidence = contrast.reshape(len(angles), -1).max(axis=1)
    return choose([s.name for s in spec.states], evidence, noise=contrast_noise(patch), seen=seen, what="knob mark")


def mark_contrast(patch: Patch, radius_m: float, angles_rad: Array) -> tuple[Array, float]:
    """Return the contrast (N,), gray levels, of a mark at each angle on a knob, and the visible share of the knob."""
    half = max(MARK_HALF_WIDTH * radius_m, 0.4 / patch.image_px_per_m)
    along_m = (MARK_FROM * radius_m, MARK_TO * radius_m)
    contrast = bar_contrast(patch, angles_rad, along_m=along_m, half_width_m=half, quantile=0.35)
    a, r = np.linspace(0, 2 * np.pi, 24), radius_m * np.array([[0.4], [0.7]])
    return np.abs(contrast), patch.seen(r * np.sin(a), r * np.cos(a))


READER = Reader[Rotary](read=read_rotary, guesses_right=0.4, is_telling=True)
