"""Toggle switches: a bat that leans up (`on`) or down (`off`) and stands out of the plate."""

from __future__ import annotations

import numpy as np

from hal.panel import Toggle
from perception.vision.patch import Patch
from perception.vision.reading import Status
from perception.vision.status.bar import bar_contrast
from perception.vision.status.choice import choose, contrast_noise

BAT_FROM, BAT_TO = 0.62, 0.95  # of the length: the nut around the foot looks like a bar too
BRIGHT_ODDS = 2.0  # bats are metal or white far more often than darker than their base
PIVOT_M = 0.004  # a bat turns about a point that far above the plate


def read_toggle(patch: Patch, spec: Toggle) -> Status:
    """State of a toggle switch. `patch` shows the plate (or any plane: heights are followed)."""
    reach, height = spec.bat_length_m * np.sin(spec.tilt_rad), spec.bat_length_m * np.cos(spec.tilt_rad)
    contrast = bar_contrast(
        patch,
        np.array([0.0, np.pi]),
        along_m=(BAT_FROM * reach, BAT_TO * reach),
        half_width_m=0.8 * spec.bat_radius_m,
        quantile=0.5,
        height_m=(PIVOT_M + BAT_FROM * height, PIVOT_M + BAT_TO * height),
        flank=(1.6, 1.9),
    )
    y = np.linspace(-1, 1, 12)[:, None] * reach
    seen = patch.seen(np.array([-1.0, 0.0, 1.0]) * spec.bat_radius_m + 0 * y, y + np.zeros(3))
    # A bat has one colour: what is dark on one side and bright on the other is the rest of the switch.
    evidence = max(
        (np.maximum(contrast, 0.0), BRIGHT_ODDS), (np.maximum(-contrast, 0.0), 1.0), key=lambda e: e[0].max() * e[1]
    )
    return choose(["on", "off"], evidence[0], noise=contrast_noise(patch), seen=seen, what="bat")
