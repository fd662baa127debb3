"""Tests of seven-segment windows drawn with known text, size, slant, blur and noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.vision_drawing import SEGMENTS
from perception.vision.photographs.dial import read_dial
from perception.vision.photographs.photo_display import read_photographed_display
from perception.vision.status.display import read_window

ENDS = {
    "a": (0, 0, 1, 0),
    "b": (1, 0, 1, 0.5),
    "c": (1, 0.5, 1, 1),
    "d": (0, 1, 1, 1),
    "e": (0, 0.5, 0, 1),
    "f": (0, 0, 0, 0.5),
    "g": (0, 0.5, 1, 0.5),
}


def window(
    text: str,
    *,
    dark: bool = False,
    slant: float = 0.1,
    blur: float = 0.8,
    noise: float = 2.0,
    high: int = 40,
    pitch: float = 1.5,
    contrast: float = 150.0,
) -> np.ndarray:
    """Return a window with the text, drawn at four times the size and reduced."""
    digits = sum(c != "." for c in text)
    width = 0.5 * high
    size = (round(1.7 * high), round(digits * pitch * width + 0.6 * high))
    k = 4
    ink = np.zeros((size[0] * k, size[1] * k), np.float32)
    left, top = 0.5 * (size[1] - (digits - 1) * pitch * width - width), 0.35 * high
    cell = -1
    for character in text:
        if character == ".":
            x = left + cell * pitch * width + width + 0.5 * (pitch - 1) * width - slant * high / 2
            cv2.circle(ink, (round(x * k), round((top + high) * k)), round(0.075 * high * k), 1.0, -1)
            continue
        cell += 1
        for segment in SEGMENTS[character]:
            x0, y0, x1, y1 = ENDS[segment]
            points = []
            for x, y, ox, oy in ((x0, y0, x1, y1), (x1, y1, x0, y0)):
                xs, ys = x + 0.12 * (ox - x), y + 0.12 * (oy - y)
                v = top + ys * high
                points.append(
                    (round((left + cell * pitch * width + xs * width + slant * (top + high / 2 - v)) * k), round(v * k))
                )
            cv2.line(ink, points[0], points[1], 1.0, round(0.11 * high * k))
    ink = cv2.GaussianBlur(cv2.resize(ink, size[::-1], interpolation=cv2.INTER_AREA), (0, 0), blur)
    gray = 190 - contrast * ink if dark else 25 + contrast * ink
    return np.clip(gray + np.random.default_rng(0).normal(0, noise, gray.shape), 0, 255).astype(np.uint8)


@given(value=st.integers(0, 9999), dark=st.booleans(), slant=st.floats(0.0, 0.18))
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
def test_any_number_is_read_exactly_or_refused(value: int, dark: bool, slant: float) -> None:
    text = f"{value:4d}"
    status = read_window(window(text, dark=dark, slant=slant), digits=4, decimals=0, dark=dark)
    assert status.text in (text.strip(), None)
    assert status.answered or len(text.strip()) < 4


@pytest.mark.parametrize("text", ["750.96", "4.11", "-4.3", "555", "88.8", "1.07"])
@pytest.mark.parametrize("dark", [True, False])
def test_digits_and_point_are_found_when_nothing_is_taught(text: str, dark: bool) -> None:
    status = read_window(window(text, dark=dark), digits=None, decimals=None, dark=dark)
    assert status.text == text


def test_blur_noise_and_low_contrast_are_read_or_refused_but_never_guessed() -> None:
    for blur, noise, contrast in (
        (2.0, 4.0, 120.0),
        (1.0, 10.0, 100.0),
        (0.8, 2.0, 25.0),
        (4.5, 6.0, 60.0),
        (1.0, 25.0, 30.0),
    ):
        status = read_window(
            window("6083", blur=blur, noise=noise, contrast=contrast), digits=4, decimals=0, dark=False
        )
        assert status.text in ("6083", None)


def test_an_empty_window_is_refused() -> None:
    empty = np.random.default_rng(1).normal(120, 3, (60, 120)).astype(np.uint8)
    status = read_window(empty, digits=4, decimals=1, dark=None)
    assert not status.answered and status.reason


def test_a_value_outside_the_range_is_refused() -> None:
    status = read_window(window("9999"), digits=4, decimals=0, dark=False, limits=(0.0, 5000.0))
    assert status.text is None and "range" in (status.reason or "")


def test_a_cropped_photograph_is_read_whatever_its_polarity() -> None:
    for dark in (True, False):
        image = cv2.resize(window("27.4", dark=dark), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
        assert read_photographed_display(image, scene=False).text == "27.4"


@pytest.mark.parametrize("value", [0.6, 2.2, 4.9, 7.7, 9.3])
def test_a_coloured_pointer_is_read_from_its_own_shape(value: float) -> None:
    image = np.full((160, 160, 3), (150, 190, 150), np.uint8)
    cv2.circle(image, (80, 80), 76, (60, 80, 60), 2, cv2.LINE_AA)
    angle = value / 10 * 2 * np.pi
    tip = np.array([80 + 60 * np.sin(angle), 80 - 60 * np.cos(angle)])
    side = 18 * np.array([np.cos(angle), np.sin(angle)])
    foot = np.array([80.0, 80.0])
    cv2.circle(image, (80, 80), 19, (150, 50, 50), -1, cv2.LINE_AA)
    cv2.fillPoly(image, [np.round([tip, foot + side, foot - side]).astype(np.int32)], (150, 50, 50), cv2.LINE_AA)
    status = read_dial(image, (0.0, 10.0), is_turn=True)
    assert status.value == pytest.approx(value, abs=0.1)
