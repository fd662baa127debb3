"""Reads a breaker: the bright tip of its handle appears in one of three places in front of the dark housing."""

from __future__ import annotations

import numpy as np

from acme_breaker.model import Breaker
from perception.vision.status import Patch, PatchReading, Reader, choose, contrast_noise

STATES = ("on", "off", "tripped")
PIVOT_M = 0.004


def read_breaker(patch: Patch, spec: Breaker) -> PatchReading:
    """Return the state of a breaker; `patch` shows the plane of the plate and is sampled at the height of the tip."""
    along = spec.bat_length_m - spec.bat_radius_m
    a = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    x, y = 0.6 * spec.bat_radius_m * np.sin(a), 0.6 * spec.bat_radius_m * np.cos(a)
    levels = []
    for lean in (spec.tilt_rad, -spec.tilt_rad, 0.0):
        tip_y, tip_z = along * np.sin(lean), PIVOT_M + along * np.cos(lean)
        levels.append(float(np.mean(patch.sample(x, y + tip_y, tip_z))))
    evidence = np.array(levels) - min(levels)  # the darkest of the three places shows the housing
    seen = patch.seen(x, y)
    return choose(STATES, evidence, noise=contrast_noise(patch), seen=seen, what="handle")


READER = Reader[Breaker](read=read_breaker, guesses_right=0.3, leans=True)
