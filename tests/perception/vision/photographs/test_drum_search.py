"""Counters in pictures: found among words and beside a unit, read with all their drums, and never sure."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.arrays import Image
from perception.vision import decode, read_photograph
from perception.vision.photographs.drum_search import find_rows, read_counter_in
from perception.vision.photographs.photo_display import OF_DRUMS
from tests.perception.vision.status.test_counter import shown

REAL = Path(__file__).resolve().parents[5] / "shared" / "data" / "vision" / "real"
PLATE = 200


def scene(seed: int) -> tuple[str, Image]:
    """Return what a drawn counter shows, and a plate with it, a unit beside it and a word below."""
    _, text, _, patch = shown(seed)
    gray = np.full((240, 460), PLATE, np.uint8)
    high, wide = patch.gray.shape
    gray[40 : 40 + high, 30 : 30 + wide] = patch.gray
    cv2.putText(gray, "m3", (40 + wide, 40 + high // 2 + 12), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 30, 3, cv2.LINE_AA)
    cv2.putText(gray, "TYPE", (90, 210), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 30, 3, cv2.LINE_AA)
    return text, gray


def test_most_standing_counters_are_read_with_all_their_drums() -> None:
    texts = [(text, read_counter_in(gray)) for text, gray in map(scene, range(300, 312, 2))]
    assert sum(found is not None and found.text == text for text, found in texts) >= 4


def test_a_picture_without_equal_distances_has_no_row() -> None:
    gray = np.full((200, 400), PLATE, np.uint8)
    for x in (20, 70, 190, 260):
        cv2.putText(gray, "8", (x, 120), cv2.FONT_HERSHEY_SIMPLEX, 1.4, 30, 3, cv2.LINE_AA)
    assert find_rows(gray, is_dark=True) == []
    assert read_counter_in(gray) is None


@pytest.mark.skipif(not REAL.is_dir(), reason="the photographs are not beside the repository")
def test_the_counters_of_real_water_meters_are_read() -> None:
    truth = json.loads((REAL / "truth.json").read_text(encoding="utf-8"))
    for name in ("meter_4.jpg", "meter_7.jpg"):  # the last two drums of the second one are between two digits
        found = read_photograph(decode((REAL / name).read_bytes()), "display", is_scene=True)
        assert found.text == truth[name]["text"], name
        assert found.confidence <= OF_DRUMS
