"""Compilation of the vision kernels in advance, or loading them from the cache, so that the first reading is fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception.vision import lights, quadrangle
from perception.vision.bilinear import step_counts
from perception.vision.finding.blind import PLATE_M, candidate_places, chosen, lay_out
from perception.vision.finding.cables import without_cables
from perception.vision.finding.features import look_at
from perception.vision.finding.framing import one_plate
from perception.vision.finding.segment import grow_regions
from perception.vision.knowledge_files import load_knowledge
from perception.vision.photographs.dial import read_dial
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.registration.edge_search import strongest_edges
from perception.vision.status.display import read_window

DIGIT_PX = (72, 40)  # height and width
STROKE_PX = 8
DIAL_PX = 110  # half side of the picture


def warm_up() -> None:
    """Run the light search, the pose of four lights, the readers of displays and pointers, and the search for objects once."""
    quadrangle.warm_up()
    lights.warm_up()
    window = three_eights()
    hidden = np.zeros(window.shape, bool)
    hidden[:, -6:] = True
    read_window(window, digits=3, decimals=1, dark=True, hidden=hidden)
    read_photographed_display(window, scene=True)
    read_dial(upright_pointer(), (0.0, 1.0), is_turn=True)
    _find_objects(window)


def _find_objects(picture: NDArray[np.uint8]) -> None:
    """Run the loops that find objects and what lies across them once, on a gray picture."""
    grow_regions(picture)
    view = one_plate(bright_plate(), PLATE_M).view
    ground = lay_out(bright_plate(), view, PLATE_M)
    places = candidate_places(ground)
    chosen(ground, places, look_at(ground, places), load_knowledge(), view, PLATE_M)
    banded = np.full((320, 480), 200, np.uint8)
    banded[:, 236:244] = 20  # a cable from top to bottom
    without_cables(banded, np.full(banded.shape, 200.0, np.float32))
    middle = np.array([[40.0, 40.0]])
    strongest_edges(picture.astype(np.float32), middle, np.array([[1.0, 0.0]]), 4.0)
    step_counts(picture, 4)


def bright_plate() -> NDArray[np.uint8]:
    """Return a picture of a bright plate with a dark disc and a dark square before a dark room."""
    v, u = np.mgrid[:480, :640]
    picture = np.where((abs(u - 320) < 280) & (abs(v - 240) < 210), 200, 40)
    picture[np.hypot(u - 200, v - 240) < 60] = 60
    picture[(abs(u - 440) < 50) & (abs(v - 240) < 50)] = 60
    return picture.astype(np.uint8)


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
