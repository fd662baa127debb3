"""Print on the plate: background, labels, and marks around each control."""

from __future__ import annotations

from hal.panel import Panel
from simbackend.bodies.body import body_of
from simbackend.canvas import PLATE, RIM, Canvas, Pixels

PLATE_PX_PER_M = 2600.0


def plate(panel: Panel) -> Pixels:
    """Return the plate: background, labels, and the print around each object and light."""
    canvas = Canvas(panel.width_m, panel.height_m, PLATE_PX_PER_M, PLATE)
    for panel_object in panel.objects:
        body_of(panel_object.kind).print_on(canvas, panel_object)
    for light in panel.lights:
        canvas.disc(light.position_m[:2], light.radius_m + 0.002, RIM)
    return canvas.pixels()
