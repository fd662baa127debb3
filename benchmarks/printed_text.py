"""Prints numbers and units on drawn gauges, in the fonts of matplotlib."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import get_data_path
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from benchmarks.vision_dials import Colour, Pen
from hal.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Print:
    """Numerals as large as on most gauges: a font of matplotlib, the height over the radius, whether tops point outwards."""

    font: str
    height: float
    is_radial: bool


def print_number(pen: Pen, how: Print, text: str, turn: float, outer: float, ink: Colour) -> None:
    """Write a number inside of its tick."""
    stamp, half = _stamp(how.font, how.height * pen.radius, text)
    if how.is_radial:
        stamp = stamp.rotate(-np.rad2deg(turn), Pillow.Resampling.BICUBIC)
    half = half / pen.radius
    reach = half[0] if how.is_radial else float(np.hypot(half[0] * np.cos(turn), half[1] * np.sin(turn)))
    _put(pen, stamp, pen.place(turn, (outer - 0.13 - reach, 0.0)), ink)


def print_unit(pen: Pen, how: Print, unit: str, ink: Colour) -> None:
    """Write the unit above or below the middle, where the face is barest, somewhat larger or smaller than the numerals."""
    rng = np.random.default_rng([*unit.encode(), round(pen.radius), round(1e3 * how.height)])
    stamp, half = _stamp(how.font, how.height * pen.radius * float(rng.uniform(0.8, 1.3)), unit)

    def print_under(place: tuple[int, int]) -> float:
        x, y = (one // 16 for one in place)
        tall, wide = (int(1.3 * one) for one in half)
        return float(pen.canvas[y - tall : y + tall, x - wide : x + wide].std())

    places = [pen.place(0.0, (along, 0.0)) for along in (*np.linspace(0.28, 0.5, 9), *np.linspace(-0.28, -0.5, 9))]
    _put(pen, stamp, min(places, key=print_under), ink)


def _stamp(font_name: str, tall_px: float, text: str) -> tuple[Pillow.Image, Array]:
    """Return a square picture of a text whose capitals have this height, and half of its height and width, px."""
    font = ImageFont.truetype(str(Path(get_data_path()) / "fonts" / "ttf" / f"{font_name}.ttf"), tall_px / 0.72)
    left, top, right, bottom = font.getbbox(text)
    side = 2 * int(np.ceil(0.6 * np.hypot(right - left, bottom - top))) + 2
    stamp = Pillow.new("L", (side, side))
    ImageDraw.Draw(stamp).text(((side - left - right) / 2, (side - top - bottom) / 2), text, fill=255, font=font)
    return stamp, 0.5 * np.array([bottom - top, right - left])


def _put(pen: Pen, stamp: Pillow.Image, place: tuple[int, int], ink: Colour) -> None:
    """Print a square picture of a text on the canvas, with its middle at a place of the pen."""
    side = stamp.width
    x, y = (one // 16 - side // 2 for one in place)
    share = np.asarray(stamp, float)[:, :, None] / 255
    under = pen.canvas[y : y + side, x : x + side]
    pen.canvas[y : y + side, x : x + side] = (under * (1 - share) + share * np.array(ink)).astype(np.uint8)
