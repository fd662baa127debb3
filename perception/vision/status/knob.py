"""Reader of knobs over a scale: the angle of the mark on the knob, and the value at which it points."""

from __future__ import annotations

import numpy as np

from hal.panel.knob import Knob
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, gated, refused
from perception.vision.status.choice import contrast_confidence, contrast_noise
from perception.vision.status.reader import Reader
from perception.vision.status.rotary import mark_contrast

STEP_RAD = np.deg2rad(1.0)
BEYOND_RAD = np.deg2rad(6.0)  # largest angle of a mark beyond its scale
RIVAL_RAD = np.deg2rad(25.0)  # anything farther away is a different mark
SIGMA_RAD = np.deg2rad(0.8)


def read_knob(patch: Patch, spec: Knob) -> PatchReading:
    """Return the value of a knob. `patch` shows the plane of the knob's face."""
    scale = spec.scale
    low, high = sorted((scale.at_min, scale.at_max))
    angles = np.arange(low - BEYOND_RAD, high + BEYOND_RAD, STEP_RAD)
    evidence, seen = mark_contrast(patch, spec.radius_m, angles)
    if seen < 0.4:
        return refused(
            "the knob cannot be seen (glare, shadow or cover): change the angle or the light", unit=scale.unit
        )
    noise = contrast_noise(patch)
    best = int(evidence.argmax())
    peak = float(evidence[best])
    if peak < 1.5 * noise:
        return refused("no mark stands out on the knob: come closer or add light", unit=scale.unit)
    rival = float(evidence[np.abs(angles - angles[best]) > RIVAL_RAD].max(initial=0.0))
    near = np.abs(angles - angles[best]) <= np.deg2rad(6.0)
    weights = np.maximum(evidence[near] - 0.5 * peak, 0.0)
    # The mark's middle, to which both flanks contribute equally
    angle = float((weights @ angles[near]) / weights.sum())
    per_rad = scale.span / abs(scale.at_max - scale.at_min)
    value = min(max(scale.value_at(angle), scale.minimum), scale.maximum)
    confidence = contrast_confidence(peak, rival, noise, seen)
    return gated(PatchReading(value=value, unit=scale.unit, uncertainty=SIGMA_RAD * per_rad, confidence=confidence))


READER = Reader[Knob](read=read_knob, guesses_right=0.3, is_telling=True)
