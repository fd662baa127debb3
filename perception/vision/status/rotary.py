"""Reader of selector knobs: the mark on the knob points at one of the taught places."""

from __future__ import annotations

import numpy as np

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
    R = spec.radius_m
    angles = np.array([state.angle_rad for state in spec.states])
    half = max(MARK_HALF_WIDTH * R, 0.4 / patch.image_px_per_m)
    tried = (angles[:, None] + WOBBLE_RAD).ravel()
    contrast = bar_contrast(patch, tried, along_m=(MARK_FROM * R, MARK_TO * R), half_width_m=half, quantile=0.35)
    evidence = np.abs(contrast).reshape(len(angles), -1).max(axis=1)
    a = np.linspace(0, 2 * np.pi, 24)
    seen = patch.seen(np.outer([0.4, 0.7], np.sin(a)) * R, np.outer([0.4, 0.7], np.cos(a)) * R)
    return choose([s.name for s in spec.states], evidence, noise=contrast_noise(patch), seen=seen, what="knob mark")


READER = Reader[Rotary](read=read_rotary, guesses_right=0.4, is_telling=True)
