"""Toggle switches: a bat that leans up (`on`) or down (`off`) and stands out of the plate."""

from __future__ import annotations

import numpy as np

from hal.panel import Toggle
from perception.vision.patch import Patch
from perception.vision.reading import Status
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise

BAT_FROM, BAT_TO = 0.70, 1.08  # of the reach: the nut around the foot looks like a bar too
PIVOT_M = 0.004  # a bat turns about a point that far above the plate


def read_toggle(patch: Patch, spec: Toggle) -> Status:
    """State of a toggle switch. `patch` shows the plate (or any plane: heights are followed)."""
    reach, height = spec.bat_length_m * np.sin(spec.tilt_rad), spec.bat_length_m * np.cos(spec.tilt_rad)
    contrast = bar_contrast(
        patch,
        np.array([0.0, np.pi]),
        along_m=(BAT_FROM * reach, BAT_TO * reach),
        half_width_m=spec.bat_radius_m,
        height_m=(PIVOT_M + BAT_FROM * height, PIVOT_M + BAT_TO * height),
        flank=(1.6, 1.9),
    )
    y = np.linspace(-1, 1, 12)[:, None] * reach
    seen = patch.seen(np.array([-1.0, 0.0, 1.0]) * spec.bat_radius_m + 0 * y, y + np.zeros(3))
    return choose(["on", "off"], np.abs(contrast), noise=contrast_noise(patch), seen=seen, what="bat")
