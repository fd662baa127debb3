"""Print on the plate: background, labels, and marks around each control; and printed tags."""

from __future__ import annotations

import cv2
import numpy as np

from hal.panel import Panel, Tag
from simbackend.bodies.body import body_of
from simbackend.canvas import PLATE, RIM, Canvas, Pixels

PLATE_PX_PER_M = 2600.0
CELL_PX = 40  # side of a cell of a tag's code in its texture


def plate(panel: Panel, size_m: tuple[float, float], middle_m: tuple[float, float]) -> Pixels:
    """Return the built plate: background, labels, and the print around each object and light.

    Args:
        size_m, middle_m: width and height of the built plate, and where its middle is in the panel frame.
    """
    canvas = Canvas(*size_m, PLATE_PX_PER_M, PLATE, middle_m)
    for panel_object in panel.objects:
        body_of(panel_object.kind).print_on(canvas, panel_object)
    for light in panel.lights:
        canvas.disc(light.position_m[:2], light.radius_m + 0.002, RIM)
    return canvas.pixels()


def tag(tag: Tag) -> tuple[Pixels, float]:
    """Return the print of a tag with a white border of one cell, and the side of that print in metres."""
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{tag.family}"))
    cells = family.markerSize + 2  # the code and its black border
    square = cv2.aruco.generateImageMarker(family, tag.id, cells * CELL_PX)
    framed = np.pad(np.asarray(square, np.uint8), CELL_PX, constant_values=255)
    return np.repeat(framed[:, :, None], 3, axis=2), tag.size_m * (cells + 2) / cells
