"""Compilation of the vision kernels in advance, or loading them from the cache, so that the first reading is fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception.vision import lights, quadrangle
from perception.vision.photographs.dial import read_dial
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.status.display import read_window

DIGIT_PX = (72, 40)  # height and width
STROKE_PX = 8
DIAL_PX = 110  # half side of the picture


def warm_up() -> None:
    """Run the light search, the pose of four lights, and the display and pointer readers once."""
    quadrangle.warm_up()
    lights.warm_up()
    window = three_eights()
    hidden = np.zeros(window.shape, bool)
    hidden[:, -6:] = True
    read_window(window, digits=3, decimals=1, dark=True, hidden=hidden)
    read_photographed_display(window, scene=True)
    read_dial(upright_pointer(), minimum=0.0, maximum=1.0, circular=True)


def upright_pointer() -> NDArray[np.uint8]:
    """Return a picture of a black pointer on a bright round face."""
    v, u = np.mgrid[-DIAL_PX:DIAL_PX, -DIAL_PX:DIAL_PX]
    face = np.where(np.hypot(u, v) < 0.95 * DIAL_PX, 200, 60)
    face[(abs(u) < 0.04 * DIAL_PX) & (v < 0.1 * DIAL_PX) & (v > -0.8 * DIAL_PX)] = 20
    return face.astype(np.uint8)


def three_eights() -> NDArray[np.uint8]:
    """Return a picture of black digits with all segments lit, and a decimal point, on gray."""
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
