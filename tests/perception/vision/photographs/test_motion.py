"""Needles that move: a swept sector is refused, several pictures give mean, amplitude and trend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.photographs import printed_way
from benchmarks.vision_manometers import draw_manometer
from hal.arrays import Image
from perception.vision import over_pictures, read_photograph
from perception.vision.photographs.dial import MOVES
from perception.vision.reading import PatchReading, SeenScale, refused

SEEDS = [seed for seed in range(530, 560) if min(draw_manometer(seed).image.shape[:2]) > 220]
SCALE = SeenScale(minimum=0.0, maximum=10.0, at_min_rad=-2.36, at_max_rad=2.36)
TURN = SeenScale(minimum=0.0, maximum=10.0, at_min_rad=0.0, at_max_rad=2 * np.pi)


def vibrating(seed: int, middle: float, amplitude: float) -> Image:
    """Return the picture of a needle that swings by `amplitude` (of the scale) while the picture is taken."""
    shares = middle + amplitude * np.sin(np.linspace(0.0, 2 * np.pi, 48, endpoint=False))
    pictures = [draw_manometer(seed, printed_way(seed), float(share)).image for share in shares]
    return np.asarray(np.mean(pictures, axis=0), np.uint8)


def read(image: Image) -> PatchReading:
    return read_photograph(image, "gauge", scale=(0.0, 10.0), ends_rad=(-2.356194, 2.356194))


def test_a_needle_that_swings_while_the_picture_is_taken_is_refused() -> None:
    swept = [read(vibrating(seed, 0.5, 0.06)) for seed in SEEDS[:6]]
    assert all(not told.answered or told.confidence < 0.8 for told in swept)
    assert sum(told.reason == MOVES for told in swept) >= 3


def test_a_needle_at_rest_is_not_said_to_move() -> None:
    still = [read(draw_manometer(seed, printed_way(seed)).image) for seed in SEEDS]
    assert len(still) >= 8 and not any(told.reason == MOVES for told in still)


def test_pictures_of_a_swinging_needle_give_mean_amplitude_and_trend() -> None:
    seed = SEEDS[0]
    shares = [0.4 + 0.02 * k + 0.05 * (-1) ** k for k in range(6)]
    told = over_pictures([read(draw_manometer(seed, printed_way(seed), share).image) for share in shares])
    assert told.value == pytest.approx(10 * float(np.mean(shares)), abs=0.1)
    assert told.motion is not None and len(told.motion.values) == 6
    slope, start = np.polyfit(range(6), shares, 1)
    assert told.motion.trend == pytest.approx(10 * slope, abs=0.05)
    assert told.motion.amplitude == pytest.approx(5 * np.ptp(np.array(shares) - slope * np.arange(6) - start), abs=0.1)


def answer(value: float, scale: SeenScale | None = SCALE, text: str | None = None) -> PatchReading:
    return PatchReading(value=value, uncertainty=0.1, confidence=0.9, scale=scale, text=text)


def test_a_full_turn_has_its_mean_across_zero() -> None:
    told = over_pictures([answer(9.8, TURN), answer(0.0, TURN), answer(0.2, TURN)])
    assert told.value is not None and min(told.value, 10.0 - told.value) == pytest.approx(0.0, abs=1e-9)
    assert told.motion is not None and told.motion.trend == pytest.approx(0.2)


def test_pictures_that_are_refused_or_have_another_scale_do_not_count() -> None:
    other = replace(SCALE, maximum=100.0)
    told = over_pictures([answer(4.0), refused("dark: add light"), answer(41.0, other), answer(4.2)])
    assert told.value == pytest.approx(4.1) and told.motion is not None
    assert told.motion.values == (4.0, None, None, 4.2)
    few = over_pictures([answer(4.0), refused("dark: add light"), refused("dark: add light")])
    assert not few.answered and few.reason == "only 1 of 3 pictures can be read; the others: dark: add light"


def test_a_display_between_two_numbers_is_read_by_the_most_pictures() -> None:
    told = over_pictures([answer(12.0, None, "12"), answer(18.0, None, "18"), answer(12.0, None, "12")])
    assert (told.text, told.value) == ("12", 12.0)
    changing = over_pictures([answer(float(k), None, str(k)) for k in (1, 2, 3)])
    assert changing.text is None and changing.value == pytest.approx(2.0)
