"""Choice of one of several named states by comparing their evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.arrays import Array
from perception.vision.bilinear import step_counts
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading, doubted, gated, probability, refused


def choose(names: Sequence[str], evidence: Array, *, noise: float, seen: float, what: str) -> PatchReading:
    """Return the state with the most evidence, or refuse if a state with another name comes close.

    Args:
        names: (N,) state names; one name may have several places.
        evidence: (N,) non-negative contrast, gray levels.
        noise: contrast that occurs by chance, gray levels.
        seen: visible share of the object, 0 to 1.
        what: name of the moving part, for the refusal's text.
    """
    if seen < 0.4:
        return refused(f"the {what} cannot be seen (glare, shadow or cover): change the angle or the light")
    unseen = f"no {what} stands out: come closer or add light"
    best = int(np.argmax(evidence))
    others = [float(e) for name, e in zip(names, evidence, strict=True) if name != names[best]]
    rival = max(others, default=0.0)
    peak = float(evidence[best])
    if peak <= 0.0:
        return refused(unseen)
    status = PatchReading(state=names[best], confidence=contrast_confidence(peak, rival, noise, seen))
    return gated(status) if peak >= 1.5 * noise else doubted(status, unseen)


def contrast_confidence(peak: float, rival: float, noise: float, seen: float) -> float:
    """Return the confidence of a contrast (gray levels) by the noise, its best rival, and the visible share of the object."""
    return probability(
        [
            (np.log(peak / noise), np.log(2.5), 0.3),
            (np.log((rival + noise) / (peak + noise)), np.log(0.70), -0.12),
            (seen, 0.55, 0.1),
        ]
    )


def contrast_noise(patch: Patch) -> float:
    """Return the contrast (gray levels) that the means of small areas of this patch reach by chance."""
    below = np.cumsum(step_counts(np.ascontiguousarray(patch.gray), 1))
    middle = np.searchsorted(below, [(below[-1] + 1) // 2, below[-1] // 2 + 1])
    return float(max(1.5, 1.2 * middle.mean()))
