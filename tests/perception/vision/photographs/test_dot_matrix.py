"""Displays of 5 x 7 dots: read as photographed, never taken from print, and wrong ones are not sure."""

from __future__ import annotations

import cv2
import numpy as np

from benchmarks.dot_matrix_drawing import draw_dots
from perception.vision import read_photograph
from perception.vision.photographs.dot_matrix import read_dots

SEEDS = range(40, 64)


def test_numbers_of_dots_are_read() -> None:
    told = [(read_photograph(case.image, "display"), case.text) for case in map(draw_dots, SEEDS)]
    assert sum(found.text == text for found, text in told) >= 0.55 * len(told)
    assert not any(found.answered and found.text != text and found.confidence >= 0.8 for found, text in told)


def test_numbers_of_dots_are_found_in_a_scene() -> None:
    cases = [draw_dots(seed, scene=True) for seed in SEEDS[:10]]
    told = [(read_photograph(case.image, "display", is_scene=True), case.text) for case in cases]
    assert sum(found.text == text for found, text in told) >= 3
    assert not any(found.answered and found.text != text and found.confidence >= 0.8 for found, text in told)


def test_printed_numbers_are_none_of_dots() -> None:
    picture = np.full((160, 420), 220, np.uint8)
    cv2.putText(picture, "3841", (40, 120), cv2.FONT_HERSHEY_DUPLEX, 3.0, 30, 8, cv2.LINE_AA)
    assert read_dots(picture, is_scene=True) is None


def test_a_picture_without_digits_has_none() -> None:
    assert read_dots(np.full((80, 200), 90, np.uint8), is_scene=False) is None
    noise = np.random.default_rng(2).integers(0, 255, (120, 300)).astype(np.uint8)
    found = read_dots(noise, is_scene=True)
    assert found is None or found.confidence < 0.5
