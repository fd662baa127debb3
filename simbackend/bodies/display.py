"""Seven-segment display: a printed face, which is printed anew for another number."""

from __future__ import annotations

import math

from hal.panel import Display
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start
from simbackend.bodies.parts import FACE_HEIGHT_M, ObjectModel, Quad
from simbackend.canvas import FACE_PX_PER_M, RIM, Canvas, Colour, Pixels
from simbackend.mechanisms import Mechanism

LED_BACK: Colour = (22, 12, 12)
LED: Colour = (255, 120, 90)
LCD_BACK: Colour = (150, 162, 138)
LCD: Colour = (28, 34, 28)

SEGMENTS = {
    "0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd",
    "6": "afgedc", "7": "abc", "8": "abcdefg", "9": "abcdfg", "-": "g", " ": "",
}  # fmt: skip


class DisplayBody(Body[Display]):
    """Display that shows one number until another one is to be shown."""

    def start(self, panel_object: Display, u: float) -> Start:
        """Return a number within its range that its digits can show."""
        low, high = _displayable(panel_object)
        value = round(low + (0.02 + 0.96 * u) * (high - low), panel_object.decimals)
        return Start(text=display_text(panel_object, value), value=value)

    def showing(self, panel_object: Display, value: float) -> Start:
        """Return a number, limited to what the digits can show."""
        low, high = _displayable(panel_object)
        shown = round(min(max(value, low), high), panel_object.decimals)
        return Start(text=display_text(panel_object, shown), value=shown)

    def model(self, panel_object: Display, start: Start) -> ObjectModel:
        """Return the face."""
        size_m = (panel_object.width_m, panel_object.height_m)
        face = display_face(panel_object, start.text or "")
        return ObjectModel(quads=(Quad(pixels=face, size_m=size_m, centre_m=(0, 0, FACE_HEIGHT_M)),))

    def print_on(self, canvas: Canvas, panel_object: Display) -> None:
        """Print the label."""
        canvas.label(panel_object.position_m, panel_object.height_m / 2, panel_object.label)

    def truth(self, panel_object: Display, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return the characters shown and their numeric value."""
        return ObjectTruth(name=panel_object.name, value=start.value, text=start.text)


def _displayable(panel_object: Display) -> tuple[float, float]:
    """Return the range of the panel file, limited to what the digits can show; a minus sign takes one digit."""
    unit = 10.0**-panel_object.decimals
    highest = (10**panel_object.digits - 1) * unit
    lowest = -(10 ** (panel_object.digits - 1) - 1) * unit
    return min(max(panel_object.minimum, lowest), highest), max(min(panel_object.maximum, highest), lowest)


def display_text(panel_object: Display, value: float) -> str:
    """Return the characters on the display, right-justified; a decimal point takes no digit."""
    text = f"{value:.{panel_object.decimals}f}"
    width = panel_object.digits + (1 if panel_object.decimals else 0)
    return text.rjust(width)


def display_face(panel_object: Display, text: str) -> Pixels:
    """Return a picture of seven-segment digits, slanted by 6 degrees, in a dark frame."""
    back, ink = (LED_BACK, LED) if panel_object.style == "led" else (LCD_BACK, LCD)
    canvas = Canvas(panel_object.width_m, panel_object.height_m, FACE_PX_PER_M, RIM)
    canvas.box((0, 0), (panel_object.width_m - 0.004, panel_object.height_m - 0.004), back, round_m=0.001)
    pitch = (panel_object.width_m - 0.008) / panel_object.digits
    high = min(0.68 * panel_object.height_m, 1.7 * pitch)
    wide = 0.52 * high
    column = -1
    for char in text:
        if char == ".":
            x = (column - (panel_object.digits - 1) / 2) * pitch + pitch / 2
            canvas.disc((x - 0.006 * high, -high / 2), 0.07 * high, ink)
            continue
        column += 1
        centre_m = (column - (panel_object.digits - 1) / 2) * pitch
        for segment in SEGMENTS[char]:
            _segment(canvas, segment, x_m=centre_m, wide=wide, high=high, ink=ink)
    return canvas.pixels()


def _segment(canvas: Canvas, segment: str, *, x_m: float, wide: float, high: float, ink: Colour) -> None:
    t = 0.065 * high  # half thickness
    gap = 0.02 * high
    w, h = wide / 2, high / 2
    flat = {"a": h - t, "g": 0.0, "d": -h + t}
    if segment in flat:
        y = flat[segment]
        shape = [(-w + t + gap, y), (-w + 2 * t + gap, y + t), (w - 2 * t - gap, y + t), (w - t - gap, y)]
        shape += [(w - 2 * t - gap, y - t), (-w + 2 * t + gap, y - t)]
    else:
        x = w - t if segment in "bc" else -w + t
        top, low = (h - t - gap, gap) if segment in "bf" else (-gap, -h + t + gap)
        shape = [(x, top), (x + t, top - t), (x + t, low + t), (x, low), (x - t, low + t), (x - t, top - t)]
    slant = math.tan(math.radians(6.0))
    canvas.polygon([(x_m + x + slant * y, y) for x, y in shape], ink)


BODY = DisplayBody()
