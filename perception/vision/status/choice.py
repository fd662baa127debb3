"""Choosing one of several named states by rival evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.arrays import Array
from perception.vision.bilinear import step_counts
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted, gated, probability, refused


def choose(names: Sequence[str], evidence: Array, *, noise: float, seen: float, what: str) -> PatchReading:
    """The state with the most evidence, unless a state of another name comes near.

    Args:
        names: (N,) state names; one name may have several places.
        evidence: (N,) non-negative contrast, gray levels.
        noise: what such a contrast reaches by chance, gray levels.
        seen: share of the object that is visible, 0 to 1.
        what: the moving part, for the refusal.
    """
    if seen < 0.4:
        return refused(f"the {what} cannot be seen (glare, shadow or cover): change the angle or the light")
    best = int(np.argmax(evidence))
    others = [float(e) for name, e in zip(names, evidence, strict=True) if name != names[best]]
    rival = max(others, default=0.0)
    peak = float(evidence[best])
    if peak <= 0.0:
        return refused(f"no {what} stands out: come closer or add light")
    confidence = probability(
        [
            (np.log(peak / noise), np.log(2.5), 0.3),
            (np.log((rival + noise) / (peak + noise)), np.log(0.70), -0.12),
            (seen, 0.55, 0.1),
        ]
    )
    status = PatchReading(state=names[best], confidence=confidence)
    return gated(status) if peak >= 1.5 * noise else doubted(status, f"no {what} stands out: come closer or add light")


def contrast_noise(patch: Patch) -> float:
    """Gray levels that a contrast between small means reaches by chance in this patch."""
    below = np.cumsum(step_counts(np.ascontiguousarray(patch.gray), 1))
    middle = np.searchsorted(below, [(below[-1] + 1) // 2, below[-1] // 2 + 1])
    return float(max(1.5, 1.2 * middle.mean()))
