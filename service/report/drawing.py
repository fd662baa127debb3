"""Draws the panel's outlines in an estimated pose over the camera's image, as in the paper's Fig. 13."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.panel import Panel
from perception.vision import contour_m
from service.report.plots import figure_png, show_image

PLATE, OBJECT, LIGHT = "#2ec4b6", "#ff9f1c", "#ffe066"
WIDTH_PX, DPI = 800, 100


def panel_drawing(
    panel: Panel, camera_from_panel: RigidTransform, intrinsics: CameraIntrinsics, pixels: NDArray[np.uint8]
) -> bytes:
    """Return a PNG of the image with plate, objects, lights and the panel's axes projected by the pose."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_PX / DPI, WIDTH_PX / DPI * intrinsics.height_px / intrinsics.width_px), dpi=DPI)
    pane = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    show_image(pane, pixels, WIDTH_PX, alpha=0.8)

    def line(points_m: Array, colour: str, width: float = 1.2) -> None:
        u, v = project(camera_from_panel.apply(points_m), intrinsics).T
        pane.plot(u, v, color=colour, lw=width)

    x, y = panel.width_m / 2, panel.height_m / 2
    line(_edges(np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0], [-x, -y, 0.0]])), PLATE, 1.8)
    for panel_object in panel.objects:
        contour = contour_m(panel_object)
        line(np.vstack([contour, contour[:1]]), OBJECT)
    turn = np.linspace(0.0, 2 * np.pi, 25)
    for light in panel.lights:
        ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1) * light.radius_m
        line(np.array(light.position_m) + ring, LIGHT, 1.6)
    for axis, colour in zip(np.eye(3) * 0.06, ("#e63946", "#57cc99", "#4895ef"), strict=True):
        line(np.array([np.zeros(3), axis]), colour, 2.4)
    pane.set_xlim(0, intrinsics.width_px - 1)
    pane.set_ylim(intrinsics.height_px - 1, 0)
    pane.set_axis_off()
    return figure_png(figure)


def _edges(corners: Array) -> Array:
    """Subdivide a polyline so finely that its edges follow the lens distortion."""
    pieces = [a + (b - a) * f for a, b in pairwise(corners) for f in np.linspace(0, 1, 20)]
    return np.array(pieces)
