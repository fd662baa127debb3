"""What is printed on the panel: plate with labels, instrument faces, seven-segment displays; uint8 RGB, by Pillow.

Every drawing is in pixels of its own image; `Canvas` turns panel metres (y up) into them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from hal.panel import (
    Button,
    Display,
    Gauge,
    Handwheel,
    Lamp,
    Lever,
    Mushroom,
    Panel,
    PanelMeter,
    PanelObject,
    Rotary,
    Scale,
    Slider,
    State,
    Toggle,
)

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

PLATE: Colour = (202, 204, 203)
INK: Colour = (34, 36, 40)
FACE: Colour = (244, 244, 238)
RIM: Colour = (30, 31, 34)
YELLOW: Colour = (236, 196, 30)
LED_BACK: Colour = (22, 12, 12)
LED: Colour = (255, 120, 90)
LCD_BACK: Colour = (150, 162, 138)
LCD: Colour = (28, 34, 28)
SMOOTH = 2  # drawn twice as large and reduced: Pillow draws hard edges
PLATE_PX_PER_M = 2600.0
FACE_PX_PER_M = 7000.0

SEGMENTS = {
    "0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd",
    "6": "afgedc", "7": "abc", "8": "abcdefg", "9": "abcdfg", "-": "g", " ": "",
}  # fmt: skip


@dataclass(eq=False)
class Canvas:
    """An image of `width_m` x `height_m` with its middle at (0, 0), y up."""

    width_m: float
    height_m: float
    px_per_m: float
    ground: Colour

    def __post_init__(self) -> None:
        self.scale = self.px_per_m * SMOOTH
        self.image = Image.new(
            "RGB", (round(self.width_m * self.scale), round(self.height_m * self.scale)), self.ground
        )
        self.draw = ImageDraw.Draw(self.image)

    def px(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Pixel of a point."""
        return ((x_m + self.width_m / 2) * self.scale, (self.height_m / 2 - y_m) * self.scale)

    def line(self, a_m: tuple[float, float], b_m: tuple[float, float], width_m: float, ink: Colour = INK) -> None:
        """A straight stroke."""
        self.draw.line([self.px(*a_m), self.px(*b_m)], fill=ink, width=max(1, round(width_m * self.scale)))

    def disc(self, centre_m: tuple[float, float], radius_m: float, fill: Colour) -> None:
        """A filled circle."""
        x, y = self.px(*centre_m)
        r = radius_m * self.scale
        self.draw.ellipse([x - r, y - r, x + r, y + r], fill=fill)

    def box(
        self, centre_m: tuple[float, float], size_m: tuple[float, float], fill: Colour, *, round_m: float = 0.0
    ) -> None:
        """A filled upright rectangle."""
        x, y = self.px(*centre_m)
        w, h = size_m[0] * self.scale / 2, size_m[1] * self.scale / 2
        self.draw.rounded_rectangle([x - w, y - h, x + w, y + h], radius=round_m * self.scale, fill=fill)

    def polygon(self, points_m: list[tuple[float, float]], fill: Colour) -> None:
        """A filled polygon."""
        self.draw.polygon([self.px(*point) for point in points_m], fill=fill)

    def text(self, centre_m: tuple[float, float], text: str, height_m: float, ink: Colour = INK) -> None:
        """Text about its middle; `height_m` is the height of a capital letter."""
        font = ImageFont.load_default(size=height_m * self.scale / 0.72)
        self.draw.text(self.px(*centre_m), text, fill=ink, font=font, anchor="mm")

    def pixels(self) -> Pixels:
        """The smooth image."""
        size = (max(1, self.image.width // SMOOTH), max(1, self.image.height // SMOOTH))
        return np.asarray(self.image.resize(size, Image.Resampling.BOX))


def plate(panel: Panel) -> Pixels:
    """The plate: ground, border line, labels, and what is printed round each control."""
    canvas = Canvas(panel.width_m, panel.height_m, PLATE_PX_PER_M, PLATE)
    for panel_object in panel.objects:
        _print_round(canvas, panel_object)
    for light in panel.lights:
        canvas.disc(light.position_m[:2], light.radius_m + 0.002, RIM)
    return canvas.pixels()


def _print_round(canvas: Canvas, panel_object: PanelObject) -> None:  # one case a kind
    match panel_object:
        case Gauge():
            _label(canvas, panel_object.position_m, panel_object.radius_m, panel_object.label)
        case PanelMeter() | Display():
            _label(canvas, panel_object.position_m, panel_object.height_m / 2, panel_object.label)
        case Lamp():
            canvas.disc(panel_object.position_m, panel_object.radius_m + 0.0025, RIM)
            _label(canvas, panel_object.position_m, panel_object.radius_m + 0.0025, panel_object.label)
        case Button():
            canvas.disc(panel_object.position_m, panel_object.radius_m + 0.003, RIM)
            _label(canvas, panel_object.position_m, panel_object.radius_m + 0.003, panel_object.label)
        case Mushroom():
            canvas.disc(panel_object.position_m, panel_object.radius_m + 0.010, YELLOW)
            _label(canvas, panel_object.position_m, panel_object.radius_m + 0.010, panel_object.label)
        case Toggle():
            canvas.box(panel_object.position_m, (0.026, 0.044), RIM, round_m=0.003)
            x, y = panel_object.position_m
            canvas.text((x + 0.021, y + 0.015), "ON", 0.0045)
            canvas.text((x + 0.021, y - 0.015), "OFF", 0.0045)
            _label(canvas, panel_object.position_m, 0.022, panel_object.label)
        case Rotary():
            for state in panel_object.states:
                _name(canvas, panel_object.position_m, state, panel_object.radius_m)
            _label(canvas, panel_object.position_m, panel_object.radius_m + 0.0025, panel_object.label)
        case Lever():
            for state in panel_object.states:
                _name(canvas, panel_object.position_m, state, panel_object.length_m)
            _label(canvas, panel_object.position_m, 0.020, panel_object.label)
        case Slider():
            _track(canvas, panel_object)
        case Handwheel():
            _label(canvas, panel_object.position_m, panel_object.radius_m + panel_object.rim_m, panel_object.label)


def _name(canvas: Canvas, at_m: tuple[float, float], state: State, radius_m: float) -> None:
    """The mark and the name of a resting place, the name pushed out by its own half width."""
    _mark(canvas, at_m, state.angle_rad, radius_m + 0.002, 0.005)
    text = state.name.upper()
    out_m = radius_m + 0.011 + abs(math.sin(state.angle_rad)) * 0.0016 * len(text)
    canvas.text(_polar(at_m, state.angle_rad, out_m), text, 0.0042)


def _label(canvas: Canvas, at_m: tuple[float, float], below_m: float, text: str) -> None:
    canvas.text((at_m[0], at_m[1] - below_m - 0.008), text, 0.0052)


def _polar(centre_m: tuple[float, float], angle_rad: float, radius_m: float) -> tuple[float, float]:
    """A point `radius_m` away, `angle_rad` clockwise from straight up."""
    return (centre_m[0] + radius_m * math.sin(angle_rad), centre_m[1] + radius_m * math.cos(angle_rad))


def _mark(canvas: Canvas, at_m: tuple[float, float], angle_rad: float, radius_m: float, length_m: float) -> None:
    canvas.line(_polar(at_m, angle_rad, radius_m), _polar(at_m, angle_rad, radius_m + length_m), 0.0012)


def _track(canvas: Canvas, panel_object: Slider) -> None:
    """Slot, ticks and numerals of a slider."""
    c, s = math.cos(panel_object.angle_rad), math.sin(panel_object.angle_rad)

    def point(along_m: float, across_m: float) -> tuple[float, float]:
        x, y = panel_object.position_m
        return (x + along_m * c - across_m * s, y + along_m * s + across_m * c)

    half_m = panel_object.travel_m / 2 + panel_object.cap_size_m[0] / 2
    corners = [point(-half_m, -0.002), point(half_m, -0.002), point(half_m, 0.002), point(-half_m, 0.002)]
    canvas.polygon(corners, RIM)
    edge_m = panel_object.cap_size_m[1] / 2 + 0.002
    for value in np.linspace(panel_object.scale.minimum, panel_object.scale.maximum, panel_object.scale.major_ticks):
        place_m = panel_object.scale.place_of(float(value))
        canvas.line(point(place_m, edge_m), point(place_m, edge_m + 0.005), 0.0009)
        canvas.text(point(place_m, edge_m + 0.010), f"{value:g}", 0.0042)
    canvas.text(point(0.0, -edge_m - 0.009), f"{panel_object.label} {panel_object.scale.unit}".strip(), 0.0052)


def gauge_face(panel_object: Gauge) -> Pixels:
    """Dark rim, white face, major and minor ticks, numerals, unit."""
    r = panel_object.radius_m
    canvas = Canvas(2 * r, 2 * r, FACE_PX_PER_M, RIM)
    canvas.disc((0, 0), 0.91 * r, FACE)
    _scale(canvas, (0.0, 0.0), panel_object.scale, outer_m=0.86 * r, text_m=0.55 * r, tall_m=0.125 * r)
    canvas.text((0.0, -0.38 * r), panel_object.scale.unit, 0.12 * r)
    return canvas.pixels()


def meter_face(panel_object: PanelMeter) -> Pixels:
    """Dark frame, white face, an arc of ticks about the pivot."""
    canvas = Canvas(panel_object.width_m, panel_object.height_m, FACE_PX_PER_M, RIM)
    canvas.box((0, 0), (panel_object.width_m - 0.006, panel_object.height_m - 0.006), FACE, round_m=0.002)
    pivot = (0.0, -panel_object.pivot_below_m)
    n = panel_object.needle_m
    _scale(canvas, pivot, panel_object.scale, outer_m=1.02 * n, text_m=1.13 * n, tall_m=0.004)
    canvas.text((0.0, pivot[1] + 0.35 * n), panel_object.scale.unit, 0.006)
    return canvas.pixels()


def _scale(
    canvas: Canvas, centre: tuple[float, float], scale: Scale, *, outer_m: float, text_m: float, tall_m: float
) -> None:
    majors = np.linspace(scale.minimum, scale.maximum, scale.major_ticks)
    place_of = scale.place_of
    for i, value in enumerate(majors):
        angle = place_of(float(value))
        _mark(canvas, centre, angle, outer_m * 0.84, outer_m * 0.16)
        canvas.text(_polar(centre, angle, text_m), f"{value:g}", tall_m)
        if i + 1 < len(majors):
            for minor in np.linspace(value, majors[i + 1], 6)[1:-1]:
                a = place_of(float(minor))
                canvas.line(_polar(centre, a, outer_m * 0.92), _polar(centre, a, outer_m), 0.0005)


def display_face(panel_object: Display, text: str) -> Pixels:
    """Seven-segment digits, slanted by 6 degrees, in a dark frame."""
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
