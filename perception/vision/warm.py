"""Compiles, or loads from the cache, what reading displays computes with, so that the first one is read as fast as any."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception.vision import lights, quadrangle
from perception.vision.photo_display import read_photograph
from perception.vision.status.display import read_window

DIGIT_PX = (72, 40)  # height and width
STROKE_PX = 8


def warm_up() -> None:
    """Run the compiled functions of the light search, the pose of four lights and the display reader once."""
    quadrangle.warm_up()
    lights.warm_up()
    window = three_eights()
    hidden = np.zeros(window.shape, bool)
    hidden[:, -6:] = True
    read_window(window, digits=3, decimals=1, dark=True, hidden=hidden)
    read_photograph(window, scene=True)


def three_eights() -> NDArray[np.uint8]:
    """Black digits with all segments lit, and a point, on gray."""
    (height, width), stroke = DIGIT_PX, STROKE_PX
    eight = np.full((height, width), 200, np.uint8)
    for top in (0, (height - stroke) // 2, height - stroke):
        eight[top : top + stroke] = 20
    eight[:, :stroke] = eight[:, -stroke:] = 20
    gap = np.full((height, 2 * stroke), 200, np.uint8)
    point = gap.copy()
    point[-stroke:, stroke // 2 : stroke // 2 + stroke] = 20
    row = np.hstack([gap, eight, gap, eight, point, eight, gap])
    return np.pad(row, 24, constant_values=200)
