"""Dials whose numerals run counter-clockwise are read by them; dials with illegible numerals are not sure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.photographs import METER_NUMERAL
from benchmarks.vision_dials import draw_dial
from perception.vision import read_photograph
from perception.vision.photographs.dial import BY_NUMERALS
from perception.vision.photographs.numeral_direction import numerals_run

SEEDS = (400000, 400002, 400005, 400006, 400008)  # numerals 9 px high or more


def drawn_face(way: int, *, font: int = cv2.FONT_HERSHEY_TRIPLEX) -> np.ndarray:
    """Return a face in letters that the reader does not compare with."""
    face = np.full((220, 220), 215, np.uint8)
    for k in range(10):
        x, y = 110 + 66 * np.sin(way * k * np.pi / 5), 110 - 66 * np.cos(way * k * np.pi / 5)
        cv2.putText(face, str(k), (round(x) - 9, round(y) + 9), font, 0.85, 40, 2, cv2.LINE_AA)
    return face


@pytest.mark.parametrize("way", [1, -1])
def test_the_direction_is_that_of_the_digits_in_other_letters_too(way: int) -> None:
    assert numerals_run(drawn_face(way), 110.0, 110.0, 100.0) == way
    assert numerals_run(255 - drawn_face(way), 110.0, 110.0, 100.0) == way
    blurred = cv2.GaussianBlur(drawn_face(way), (0, 0), 2.0)
    assert numerals_run(np.asarray(blurred, np.uint8), 110.0, 110.0, 100.0) == way


def test_no_direction_is_told_without_legible_numerals() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (220, 220)).astype(np.uint8)
    assert numerals_run(noise, 110.0, 110.0, 100.0) == 0
    assert numerals_run(np.full((220, 220), 200, np.uint8), 110.0, 110.0, 100.0) == 0
    assert numerals_run(drawn_face(1), 110.0, 110.0, 20.0) == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dial_that_falls_is_read_by_its_numerals_but_not_surely(seed: int) -> None:
    drawn = draw_dial(seed, falls=True, circular=True, numeral=METER_NUMERAL)
    told = read_photograph(drawn.image, "dial", scale=(0.0, 10.0))
    assert told.confidence <= BY_NUMERALS
    assert told.value is None or abs((told.value - drawn.reading + 5.0) % 10.0 - 5.0) < 0.25
    surely = read_photograph(drawn.image, "dial", scale=(10.0, 0.0))
    assert surely.value == told.value


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dial_whose_numerals_are_illegible_is_not_sure(seed: int) -> None:
    drawn = draw_dial(seed, falls=True, circular=True)
    assert read_photograph(drawn.image, "dial", scale=(0.0, 10.0)).confidence <= BY_NUMERALS


def test_a_scale_against_the_numerals_is_refused() -> None:
    drawn = draw_dial(SEEDS[0], circular=True, numeral=METER_NUMERAL)
    right = read_photograph(drawn.image, "dial", scale=(0.0, 10.0))
    assert right.value == pytest.approx(drawn.reading, abs=0.2) and right.confidence > BY_NUMERALS
    told = read_photograph(drawn.image, "dial", scale=(10.0, 0.0))
    assert told.value is None and told.reason is not None and "clockwise" in told.reason


def test_a_scale_without_ten_numerals_is_not_read_by_them() -> None:
    drawn = draw_dial(SEEDS[0], falls=True, circular=True, numeral=METER_NUMERAL)
    rising = read_photograph(drawn.image, "dial", scale=(0.0, 6.0))
    assert rising.value is not None and rising.value == pytest.approx(6.0 - 0.6 * drawn.reading, abs=0.15)
    assert rising.confidence <= BY_NUMERALS
