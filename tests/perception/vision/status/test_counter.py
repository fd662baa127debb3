"""Counters drawn with a font of their own, tilted, blurred and noisy: read right, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from hal.panel.counter import Counter
from perception.vision.patch import Patch
from perception.vision.status.counter import read_counter

PX_PER_M, MARGIN, FINE = 3600.0, 1.25, 4
WINDOW, PITCH = 0.8, 0.8  # over the counter's height


def counter(ink: str = "white", decimals: int = 0) -> Counter:
    return Counter.model_validate(
        {
            "name": "hours",
            "position_m": (0.0, 0.0),
            "width_m": 0.065,
            "height_m": 0.018,
            "decimals": decimals,
            "ink": ink,
        }
    )


FOLDER = Path(matplotlib.get_data_path()) / "fonts/ttf"
FONTS = ("DejaVuSans", "DejaVuSans-Bold", "DejaVuSansMono-Bold", "DejaVuSerif-Bold", "cmss10")


def font_of(name: str | None, digit_px: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return a font of matplotlib's, or Pillow's own, whose digits are so tall."""
    if name is None:
        return ImageFont.load_default(size=digit_px / 0.72)
    top, bottom = ImageFont.truetype(FOLDER / f"{name}.ttf", size=100).getbbox("0", anchor="ls")[1::2]
    return ImageFont.truetype(FOLDER / f"{name}.ttf", size=100.0 * digit_px / (bottom - top))


def drawn(spec: Counter, text: str, turned: float, rng: np.random.Generator, font_name: str | None = None) -> Patch:
    """The patch of a counter by Pillow's own font: uneven light, a tilt of up to 1.5 degrees, blur and noise."""
    scale = PX_PER_M * FINE
    w, h = round(MARGIN * spec.width_m * scale), round(MARGIN * spec.height_m * scale)
    ink, ground = (225, 35) if spec.ink == "white" else (40, 215)
    tall = rng.uniform(0.48, 0.58) * spec.height_m * scale
    font = font_of(font_name, tall)
    picture = Image.new("L", (w, h), 200)
    frame = Image.new("L", (round(spec.width_m * scale), round(spec.height_m * scale)), 60)
    cell_h, cell_w = round(WINDOW * frame.height), round(0.86 * frame.width / spec.digits)
    carry = turned
    for k in reversed(range(spec.digits)):
        drum = Image.new("L", (cell_w, cell_h), ground)
        pen, digit = ImageDraw.Draw(drum), int(text[k])
        for j in (0, 1):
            y = cell_h / 2 + (j - carry) * PITCH * frame.height + rng.normal(0.0, 0.008) * frame.height
            pen.text(
                (cell_w / 2 + rng.normal(0.0, 0.02) * cell_w, y), str((digit + j) % 10), ink, font=font, anchor="mm"
            )
        carry = carry if digit == 9 else 0.0
        frame.paste(drum, (round((k + 0.5) * frame.width / spec.digits - cell_w / 2), (frame.height - cell_h) // 2))
    picture.paste(frame, ((w - frame.width) // 2, (h - frame.height) // 2))
    turn = cv2.getRotationMatrix2D((w / 2, h / 2), float(rng.uniform(-1.5, 1.5)), 1.0)
    tilted = cv2.warpAffine(np.asarray(picture, np.float32), turn, (w, h), borderMode=cv2.BORDER_REPLICATE)
    small = cv2.resize(tilted, (w // FINE, h // FINE), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), float(rng.uniform(0.4, 1.4)))
    light = rng.uniform(0.5, 1.0) * np.linspace(1.0, rng.uniform(0.7, 1.0), blurred.shape[1])
    gray = np.clip(blurred * light + rng.normal(0.0, 4.0, blurred.shape), 0, 245).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones_like(gray, bool), px_per_m=PX_PER_M,
        origin_px=(np.array(gray.shape[::-1]) - 1) / 2, plane_z_m=0.0, parallax_px_per_m=np.zeros(2),
        growth_per_m=0.0, image_px_per_m=PX_PER_M,
    )  # fmt: skip


def shown(seed: int, font_name: str | None = None) -> tuple[Counter, str, float, Patch]:
    """What the counter of a seed is, shows, and how that looks; every other one has its last drum between two digits."""
    rng = np.random.default_rng(seed)
    spec = counter("white" if seed % 3 else "black")
    text = f"{rng.integers(100_000):05d}"
    turned = float(rng.uniform(0.1, 0.8)) if seed % 2 else 0.0
    return spec, text, turned, drawn(spec, text, turned, rng, font_name)


def test_of_twenty_counters_nineteen_are_read_and_none_is_wrong() -> None:
    right = 0
    for seed in range(20):
        spec, text, turned, patch = shown(seed)
        reading = read_counter(patch, spec)
        if reading.answered:
            assert reading.text == text, seed
            assert reading.value == pytest.approx(int(text) + turned, abs=0.15), seed
            right += 1
    assert right >= 19


@pytest.mark.parametrize("name", FONTS)
def test_digits_of_other_typefaces_are_read_and_none_is_wrong(name: str) -> None:
    right = 0
    for seed in range(100, 108):
        spec, text, turned, patch = shown(seed, name)
        reading = read_counter(patch, spec)
        if reading.answered:
            assert reading.text == text, seed
            assert reading.value == pytest.approx(int(text) + turned, abs=0.15), seed
            right += 1
    assert right >= 7


@pytest.mark.parametrize(("text", "turned"), [("00999", 0.4), ("12399", 0.6), ("40009", 0.3)])
def test_drums_turn_with_the_one_that_passes_nine(text: str, turned: float) -> None:
    reading = read_counter(drawn(counter(), text, turned, np.random.default_rng(3)), counter())
    assert reading.text == text
    assert reading.value == pytest.approx(int(text) + turned, abs=0.15)


def test_a_drum_about_to_show_its_next_digit_is_not_read() -> None:
    reading = read_counter(drawn(counter(), "31415", 0.9, np.random.default_rng(3)), counter())
    assert reading.reason is not None and "next digit" in reading.reason


def test_the_point_stands_where_the_panel_file_says() -> None:
    spec = counter(decimals=1)
    reading = read_counter(drawn(spec, "31415", 0.0, np.random.default_rng(5)), spec)
    assert reading.text == "3141.5" and reading.value == pytest.approx(3141.5, abs=0.02)


def test_a_covered_drum_an_empty_face_and_glare_are_refused() -> None:
    patch = drawn(counter(), "31415", 0.0, np.random.default_rng(7))
    width = patch.gray.shape[1]
    across, empty, glare = (patch.gray.copy() for _ in range(3))
    across[:, width // 2 - 14 : width // 2 + 14] = 30
    empty[:] = 120 + np.random.default_rng(1).normal(0.0, 4.0, empty.shape).astype(np.uint8) % 5
    glare[:, width // 3 : width // 2] = 255
    for gray in (across, empty, glare):
        assert read_counter(replace(patch, gray=gray), counter()).reason is not None
