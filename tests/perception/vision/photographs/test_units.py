"""The unit on the face of a gauge is read, and nothing else is taken for one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.gauge_units import UNITS
from benchmarks.photographs import printed_way
from benchmarks.vision_manometers import Way, draw_manometer
from hal.arrays import Image
from perception.vision import read_photograph
from perception.vision.photographs.units import UNITS as SPELLINGS
from perception.vision.photographs.units import find_unit

RADIUS_PX = 200
MIDDLE_PX = RADIUS_PX + 10


def face(*texts: tuple[str, int], font: int = cv2.FONT_HERSHEY_DUPLEX, ink: int = 30, paper: int = 220) -> Image:
    """Return a square with texts in the middle of its width, each at a height, px below the middle."""
    gray = np.full((2 * MIDDLE_PX, 2 * MIDDLE_PX), paper, np.uint8)
    for text, below_px in texts:
        (w, h), _ = cv2.getTextSize(text, font, 0.9, 2)
        cv2.putText(gray, text, (MIDDLE_PX - w // 2, MIDDLE_PX + below_px + h // 2), font, 0.9, ink, 2, cv2.LINE_AA)
    return gray


def unit_on(gray: Image) -> str:
    return find_unit(gray, MIDDLE_PX, MIDDLE_PX, RADIUS_PX)


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("font", [cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX])
def test_every_spelling_is_read(spelling: str, font: int) -> None:
    assert unit_on(face((spelling, 80), font=font)) == SPELLINGS[spelling]
    assert unit_on(face((spelling, -70), font=font, ink=230, paper=40)) == SPELLINGS[spelling]


@pytest.mark.parametrize("text", ["PRESSURE", "EN 837-1", "CL 1.6", "barrel", "10", "OIL", "STEAM", "Made in"])
def test_other_words_are_no_unit(text: str) -> None:
    assert unit_on(face((text, 80))) == ""


def test_which_of_two_units_belongs_to_the_scale_is_not_guessed() -> None:
    assert unit_on(face(("bar", 80), ("psi", -70))) == ""
    assert unit_on(face(("bar", 80), ("BAR", -70))) == "bar"


def test_a_word_that_reaches_the_scale_is_no_unit() -> None:
    assert unit_on(face(("bar", 190))) == ""


@pytest.mark.parametrize("seed", range(1, 5))
def test_an_answer_has_the_unit_that_is_printed_on_the_gauge(seed: int) -> None:
    unit = UNITS[seed]
    way: Way = replace(printed_way(seed), unit=unit)
    drawn = draw_manometer(seed, way)
    ends = (way.angle_rad(0.0), way.angle_rad(1.0))
    found = read_photograph(drawn.image, "gauge", scale=(0.0, drawn.full), ends_rad=ends)
    assert found.answered and found.unit in ("", unit)
