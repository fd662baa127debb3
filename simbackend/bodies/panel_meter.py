"""Moving-coil meter: a framed face and a needle above it."""

from __future__ import annotations

from hal.panel import PanelMeter
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start, place_of
from simbackend.bodies.parts import FACE_HEIGHT_M, ObjectModel, Quad, needle, needle_height_m
from simbackend.canvas import FACE, FACE_PX_PER_M, RIM, Canvas, Pixels
from simbackend.mechanisms import Mechanism


class PanelMeterBody(Body[PanelMeter]):
    """Meter whose needle stays at one value of the scale until another one is to be shown."""

    def start(self, panel_object: PanelMeter, u: float) -> Start:
        """Return a value away from the ends of the scale."""
        scale = panel_object.scale
        value = scale.minimum + (0.05 + 0.9 * u) * (scale.maximum - scale.minimum)
        return Start(place=scale.place_of(value), value=value)

    def showing(self, panel_object: PanelMeter, value: float) -> Start:
        """Return the needle at a value, also beyond the ends of the scale."""
        return Start(place=panel_object.scale.place_of(value), value=value)

    def model(self, panel_object: PanelMeter, start: Start) -> ObjectModel:
        """Return face and needle."""
        urdf = needle(
            length_m=panel_object.needle_m,
            tail_m=0.12 * panel_object.needle_m,
            width_m=0.0016,
            height_m=needle_height_m(panel_object.depth_m),
            pivot_y_m=-panel_object.pivot_below_m,
        )
        size_m = (panel_object.width_m, panel_object.height_m)
        face = Quad(pixels=meter_face(panel_object), size_m=size_m, centre_m=(0, 0, FACE_HEIGHT_M))
        return ObjectModel(urdf=urdf, quads=(face,), place=start.place)

    def print_on(self, canvas: Canvas, panel_object: PanelMeter) -> None:
        """Print the label."""
        canvas.label(panel_object.position_m, panel_object.height_m / 2, panel_object.label)

    def truth(
        self, panel_object: PanelMeter, start: Start, mechanism: Mechanism | None, *, is_lit: bool
    ) -> ObjectTruth:
        """Return the value that the needle shows."""
        return ObjectTruth(name=panel_object.name, value=panel_object.scale.value_at(place_of(mechanism)))


def meter_face(panel_object: PanelMeter) -> Pixels:
    """Return a picture with dark frame, white face, and an arc of ticks around the pivot."""
    canvas = Canvas(panel_object.width_m, panel_object.height_m, FACE_PX_PER_M, RIM)
    canvas.box((0, 0), (panel_object.width_m - 0.006, panel_object.height_m - 0.006), FACE, round_m=0.002)
    pivot = (0.0, -panel_object.pivot_below_m)
    n = panel_object.needle_m
    canvas.scale(pivot, panel_object.scale, outer_m=1.02 * n, text_m=1.13 * n, tall_m=0.004)
    canvas.text((0.0, pivot[1] + 0.35 * n), panel_object.scale.unit, 0.006)
    return canvas.pixels()


BODY = PanelMeterBody()
