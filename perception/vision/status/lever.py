"""Quarter-turn levers: a bar from the hub towards one of the taught angles."""

from __future__ import annotations

import numpy as np

from hal.panel import Lever
from perception.vision.patch import Patch
from perception.vision.reading import Status
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise

BAR_FROM, BAR_TO = 0.40, 0.92  # share of the length: outside the hub, inside the tip
WOBBLE_RAD = np.deg2rad(np.linspace(-10, 10, 9))


def read_lever(patch: Patch, spec: Lever) -> Status:
    """State of a lever valve. `patch` shows the plane of the bar; several states may share a name."""
    L = spec.length_m
    angles = np.array([state.angle_rad for state in spec.states])
    tried = (angles[:, None] + WOBBLE_RAD).ravel()
    contrast = bar_contrast(
        patch, tried, along_m=(BAR_FROM * L, BAR_TO * L), half_width_m=spec.width_m / 2, flank=(1.35, 1.6)
    )
    evidence = np.abs(contrast).reshape(len(angles), -1).max(axis=1)
    r = np.linspace(BAR_FROM, BAR_TO, 8)[:, None] * L
    seen = patch.seen(r * np.sin(angles), r * np.cos(angles))
    return choose([s.name for s in spec.states], evidence, noise=contrast_noise(patch), seen=seen, what="lever")
