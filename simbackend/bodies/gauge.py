"""Round instrument: a printed face and a needle above it."""

from __future__ import annotations

from hal.panel import Gauge
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import FACE_HEIGHT_M, ObjectModel, Quad, needle, needle_height_m
from simbackend.canvas import FACE, FACE_PX_PER_M, RIM, Canvas, Pixels
from simbackend.mechanisms import Mechanism


class GaugeBody(Body[Gauge]):
    """Gauge whose needle stays at one value of the scale until another one is to be shown."""

    def start(self, panel_object: Gauge, u: float) -> Start:
        """Return a value away from the ends of the scale."""
        scale = panel_object.scale
        value = scale.minimum + (0.05 + 0.9 * u) * (scale.maximum - scale.minimum)
        return Start(place=scale.place_of(value), value=value)

    def showing(self, panel_object: Gauge, value: float) -> Start:
        """Return the needle at a value, also beyond the ends of the scale."""
        return Start(place=panel_object.scale.place_of(value), value=value)

    def model(self, panel_object: Gauge, start: Start) -> ObjectModel:
        """Return face and needle."""
        r, above_m = panel_object.radius_m, needle_height_m(panel_object.depth_m)
        urdf = needle(length_m=0.76 * r, tail_m=0.22 * r, width_m=0.055 * r, height_m=above_m, pivot_y_m=0.0)
        face = Quad(
            pixels=gauge_face(panel_object), size_m=(2 * r, 2 * r), centre_m=(0, 0, FACE_HEIGHT_M), is_round=True
        )
        return ObjectModel(urdf=urdf, quads=(face,), place=start.place)

    def print_on(self, canvas: Canvas, panel_object: Gauge) -> None:
        """Print the label."""
        canvas.label(panel_object.position_m, panel_object.radius_m, panel_object.label)

    def truth(self, panel_object: Gauge, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the value that the needle shows."""
        return ObjectTruth(name=panel_object.name, value=panel_object.scale.value_at(place_of(mechanism)))


def gauge_face(panel_object: Gauge) -> Pixels:
    """Return a picture with dark rim, white face, major and minor ticks, numerals and unit."""
    r, scale = panel_object.radius_m, panel_object.scale
    canvas = Canvas(2 * r, 2 * r, FACE_PX_PER_M, RIM)
    canvas.disc((0, 0), 0.91 * r, FACE)
    canvas.scale((0.0, 0.0), scale, outer_m=0.86 * r, text_m=0.55 * r, tall_m=0.125 * r)
    canvas.text((0.0, -0.38 * r), scale.unit, 0.12 * r)
    return canvas.pixels()


BODY = GaugeBody()
