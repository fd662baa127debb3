"""Drawings on the panel: uint8 RGB pictures by Pillow, in panel metres with y up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from hal.panel import Scale, State

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

PLATE: Colour = (202, 204, 203)
INK: Colour = (34, 36, 40)
FACE: Colour = (244, 244, 238)
RIM: Colour = (30, 31, 34)
YELLOW: Colour = (236, 196, 30)
SMOOTH = 2  # drawn at twice the size and reduced, because Pillow does not anti-alias
FACE_PX_PER_M = 7000.0


@dataclass(eq=False)
class Canvas:
    """Image of `width_m` x `height_m` around `middle_m`, y up."""

    width_m: float
    height_m: float
    px_per_m: float
    ground: Colour
    middle_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self.zoom = self.px_per_m * SMOOTH
        self.image = Image.new("RGB", (round(self.width_m * self.zoom), round(self.height_m * self.zoom)), self.ground)
        self.draw = ImageDraw.Draw(self.image)

    def px(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the pixel coordinates of a point."""
        x_m, y_m = x_m - self.middle_m[0], y_m - self.middle_m[1]
        return ((x_m + self.width_m / 2) * self.zoom, (self.height_m / 2 - y_m) * self.zoom)

    def line(self, a_m: tuple[float, float], b_m: tuple[float, float], width_m: float, ink: Colour = INK) -> None:
        """Draw a straight line."""
        self.draw.line([self.px(*a_m), self.px(*b_m)], fill=ink, width=max(1, round(width_m * self.zoom)))

    def disc(self, centre_m: tuple[float, float], radius_m: float, fill: Colour) -> None:
        """Draw a filled circle."""
        x, y = self.px(*centre_m)
        r = radius_m * self.zoom
        self.draw.ellipse([x - r, y - r, x + r, y + r], fill=fill)

    def box(
        self, centre_m: tuple[float, float], size_m: tuple[float, float], fill: Colour, *, round_m: float = 0.0
    ) -> None:
        """Draw a filled upright rectangle."""
        x, y = self.px(*centre_m)
        w, h = size_m[0] * self.zoom / 2, size_m[1] * self.zoom / 2
        self.draw.rounded_rectangle([x - w, y - h, x + w, y + h], radius=round_m * self.zoom, fill=fill)

    def polygon(self, points_m: list[tuple[float, float]], fill: Colour) -> None:
        """Draw a filled polygon."""
        self.draw.polygon([self.px(*point) for point in points_m], fill=fill)

    def text(self, centre_m: tuple[float, float], text: str, height_m: float, ink: Colour = INK) -> None:
        """Draw text around its centre; `height_m` is the height of a capital letter."""
        font = ImageFont.load_default(size=height_m * self.zoom / 0.72)
        self.draw.text(self.px(*centre_m), text, fill=ink, font=font, anchor="mm")

    def pixels(self) -> Pixels:
        """Return the anti-aliased image."""
        size = (max(1, self.image.width // SMOOTH), max(1, self.image.height // SMOOTH))
        return np.asarray(self.image.resize(size, Image.Resampling.BOX))

    def label(self, at_m: tuple[float, float], below_m: float, text: str) -> None:
        """Draw an object's label below it."""
        self.text((at_m[0], at_m[1] - below_m - 0.008), text, 0.0052)

    def mark(self, at_m: tuple[float, float], angle_rad: float, radius_m: float, length_m: float) -> None:
        """Draw a radial line that begins `radius_m` away from a point, `angle_rad` clockwise from straight up."""
        self.line(polar(at_m, angle_rad, radius_m), polar(at_m, angle_rad, radius_m + length_m), 0.0012)

    def place_name(self, at_m: tuple[float, float], state: State, radius_m: float) -> None:
        """Draw the mark and the name of a state, with the name moved outwards by half its width."""
        self.mark(at_m, state.angle_rad, radius_m + 0.002, 0.005)
        text = state.name.upper()
        out_m = radius_m + 0.011 + abs(math.sin(state.angle_rad)) * 0.0016 * len(text)
        self.text(polar(at_m, state.angle_rad, out_m), text, 0.0042)

    def scale(
        self, centre_m: tuple[float, float], scale: Scale, *, outer_m: float, text_m: float, tall_m: float
    ) -> None:
        """Draw major and minor ticks that end `outer_m` from a pivot, and numerals `text_m` from it."""
        majors = np.linspace(scale.minimum, scale.maximum, scale.major_ticks)
        for i, value in enumerate(majors):
            angle = scale.place_of(float(value))
            self.mark(centre_m, angle, outer_m * 0.84, outer_m * 0.16)
            self.text(polar(centre_m, angle, text_m), f"{value:g}", tall_m)
            if i + 1 < len(majors):
                for minor in np.linspace(value, majors[i + 1], 6)[1:-1]:
                    a = scale.place_of(float(minor))
                    self.line(polar(centre_m, a, outer_m * 0.92), polar(centre_m, a, outer_m), 0.0005)


def polar(centre_m: tuple[float, float], angle_rad: float, radius_m: float) -> tuple[float, float]:
    """Return the point `radius_m` away, `angle_rad` clockwise from straight up."""
    return (centre_m[0] + radius_m * math.sin(angle_rad), centre_m[1] + radius_m * math.cos(angle_rad))
