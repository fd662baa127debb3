"""Cables in front of a plate are found completely and bridged, and nothing else is taken for a cable."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hal.arrays import Image
from perception.vision.finding.cables import without_cables

PLATE_GRAY = 140.0
LINE = np.array([[250, -10], [290, 220], [210, 460]], np.int32)
WIDTH_PX = 9


def plate(*, seed: int = 3) -> Image:
    """Draw a plate with a dark meter, a bright dial and a long flat track."""
    picture = np.full((450, 600), PLATE_GRAY, np.float32)
    cv2.rectangle(picture, (60, 60), (180, 150), 40.0, -1)
    cv2.circle(picture, (270, 300), 50, 220.0, -1, cv2.LINE_AA)
    cv2.rectangle(picture, (420, 100), (425, 330), 45.0, -1)
    noise = np.random.default_rng(seed).normal(0, 2.0, picture.shape)
    return np.asarray(np.clip(np.round(picture + noise), 0, 255), np.uint8)


def level() -> np.ndarray:
    return np.full((450, 600), PLATE_GRAY, np.float32)


def covered() -> np.ndarray:
    """Return the mask of the cable."""
    mask = np.zeros((450, 600), np.uint8)
    cv2.polylines(mask, [LINE], False, 1, WIDTH_PX)
    return mask > 0


@pytest.mark.parametrize("gray", [20.0, 75.0])
def test_a_cable_is_bridged_and_the_rest_stays(gray: float) -> None:
    bare = plate()
    hung = bare.copy()
    hung[covered()] = gray
    seen = without_cables(hung, level())
    error = np.abs(seen.astype(float) - bare)
    dial = np.hypot(*(np.indices(bare.shape)[::-1] - np.array([270, 300])[:, None, None])) < 70
    assert np.median(error[covered()]) < 8.0
    assert np.mean(error[covered() & ~dial] < 20.0) > 0.95
    beside = cv2.dilate(covered().astype(np.uint8), np.ones((1, 25), np.uint8)) > 0
    assert np.array_equal(seen[~beside], bare[~beside])


def test_a_plate_without_cables_is_left_as_it_is() -> None:
    bare = plate()
    assert without_cables(bare, level()) is bare


def test_a_column_of_dark_buttons_is_no_cable() -> None:
    picture = np.full((450, 600), PLATE_GRAY, np.float32)
    for top in range(0, 450, 44):
        cv2.circle(picture, (300, top + 20), 19, 25.0, -1, cv2.LINE_AA)
    bare = np.asarray(picture, np.uint8)
    assert without_cables(bare, level()) is bare


def test_two_cables_that_cross_are_both_bridged() -> None:
    bare = plate()
    mask = np.zeros(bare.shape, np.uint8)
    cv2.line(mask, (240, -5), (360, 455), 1, 7)
    cv2.line(mask, (380, -5), (200, 455), 1, 11)
    hung = bare.copy()
    hung[mask > 0] = 30
    seen = without_cables(hung, level()).astype(float)
    assert np.mean(np.abs(seen - bare)[mask > 0] < 25.0) > 0.8


def test_a_cable_that_leaves_the_plate_at_its_side_is_bridged_as_far_as_it_goes() -> None:
    bare = plate()
    mask = np.zeros(bare.shape, np.uint8)
    cv2.line(mask, (560, -5), (620, 300), 1, 9)
    hung = bare.copy()
    hung[mask > 0] = 30
    seen = without_cables(hung, level()).astype(float)
    assert np.mean(np.abs(seen - bare)[mask > 0] < 25.0) > 0.7  # at the border only one side of it is visible
