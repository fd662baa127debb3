"""A mechanical counter: drums behind windows, printed as they stand."""

from __future__ import annotations

from hal.panel.counter import DRUM_PITCH, Counter
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start
from simbackend.bodies.parts import FACE_HEIGHT_M, ObjectModel, Quad
from simbackend.canvas import FACE_PX_PER_M, RIM, Canvas, Colour, Pixels
from simbackend.mechanisms import Mechanism

BLACK: Colour = (20, 20, 22)
WHITE: Colour = (240, 240, 234)
RED: Colour = (150, 24, 22)
DIGIT, WINDOW = 0.54, 0.80  # heights, over the counter's
STANDING = 0.5  # share of the worlds in which no drum is turning


class CounterBody(Body[Counter]):
    """It shows one number for as long as the world lasts; in half of all worlds its last drum stands between two digits."""

    def start(self, panel_object: Counter, u: float) -> Start:
        """Return a number of its range that its digits can show."""
        step = panel_object.step
        low, high = panel_object.minimum, min(panel_object.maximum, (10**panel_object.digits - 1) * step)
        steps = (low + (0.02 + 0.96 * u) * (high - low)) / step
        count = int(steps)
        turned = max(0.0, (steps - count) - STANDING) / (1.0 - STANDING)
        return Start(text=panel_object.text_of(count), value=(count + turned) * step)

    def model(self, panel_object: Counter, start: Start) -> ObjectModel:
        """Return the printed face."""
        face = counter_face(panel_object, (start.value or 0.0) / panel_object.step)
        size_m = (panel_object.width_m, panel_object.height_m)
        return ObjectModel(quads=(Quad(pixels=face, size_m=size_m, centre_m=(0, 0, FACE_HEIGHT_M)),))

    def print_on(self, canvas: Canvas, panel_object: Counter) -> None:
        """Print the label."""
        canvas.label(panel_object.position_m, panel_object.height_m / 2, panel_object.label)

    def truth(self, panel_object: Counter, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the lower digits, and where the last drum stands."""
        return ObjectTruth(name=panel_object.name, value=start.value, text=start.text)


def counter_face(panel_object: Counter, steps: float) -> Pixels:
    """Draw drums that have counted `steps`, in a dark frame; drums after the point are red where digits are white."""
    h, pitch = panel_object.height_m, panel_object.pitch_m
    canvas = Canvas(panel_object.width_m, h, FACE_PX_PER_M, RIM)
    places = drum_places(steps, panel_object.digits)
    ink, ground = (WHITE, BLACK) if panel_object.ink == "white" else (BLACK, WHITE)
    for k, place in enumerate(places):
        x = (k - (panel_object.digits - 1) / 2) * pitch
        is_after_point = k >= panel_object.digits - panel_object.decimals
        canvas.box((x, 0), (0.86 * pitch, WINDOW * h), RED if is_after_point and ink == WHITE else ground)
        for digit in (int(place), int(place) + 1):
            canvas.text((x, (place - digit) * DRUM_PITCH * h), str(digit % 10), DIGIT * h, ink)
    for side in (-1, 1):  # the frame hides what has not come into a window
        canvas.box((0, side * (1 + WINDOW) * h / 4), (panel_object.width_m, (1 - WINDOW) * h / 2), RIM)
    return canvas.pixels()


def drum_places(steps: float, digits: int) -> list[float]:
    """Return where each drum stands, first one first, in digits: the last gradually, another with the one that passes 9."""
    count, turned = int(steps), steps - int(steps)
    places = []
    for _ in range(digits):
        count, digit = divmod(count, 10)
        places.append(digit + turned)
        turned = turned if digit == 9 else 0.0
    return places[::-1]


BODY = CounterBody()
