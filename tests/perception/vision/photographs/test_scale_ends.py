"""Tests of finding the ends of a scale by its ticks only, on drawn faces with known ends and without ends."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hal.arrays import Image
from perception.vision.photographs.scale_ends import scale_ends

SIDE_PX, RADIUS_PX = 300, 130.0
MIDDLE_PX = 0.5 * (SIDE_PX - 1)


def face(first_deg: float, last_deg: float, steps: int, *, light: bool = False, seed: int = 1) -> Image:
    """Draw ticks from one angle to the other, 18 px long, with noise."""
    ground, ink = (60, 220) if light else (220, 40)
    image = np.full((SIDE_PX, SIDE_PX), ground, np.uint8)
    for turn in np.deg2rad(np.linspace(first_deg, last_deg, steps + 1)):
        way = np.array([np.sin(turn), -np.cos(turn)])
        inner, outer = (tuple(int(v) for v in np.round(16 * (MIDDLE_PX + r * RADIUS_PX * way))) for r in (0.76, 0.9))
        cv2.line(image, inner, outer, ink, 2, cv2.LINE_AA, 4)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + np.random.default_rng(seed).normal(0.0, 4.0, image.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


@pytest.mark.parametrize("light", [False, True])
@pytest.mark.parametrize(
    ("first_deg", "last_deg", "steps"),
    [
        (-135.0, 135.0, 40),
        (-90.0, 90.0, 30),
        (-45.0, 45.0, 10),
        (-120.0, 120.0, 12),
        (-150.0, 150.0, 60),
        (-123.0, 147.0, 20),
    ],
)
def test_the_first_and_the_last_tick_are_found(first_deg: float, last_deg: float, steps: int, light: bool) -> None:
    found = scale_ends(face(first_deg, last_deg, steps, light=light), MIDDLE_PX, MIDDLE_PX, RADIUS_PX)
    assert found is not None
    assert np.rad2deg(found) == pytest.approx([first_deg, last_deg], abs=1.0)


def test_ticks_that_a_pointer_covers_are_stepped_over() -> None:
    image = face(-90.0, 90.0, 36)
    end = (
        round(MIDDLE_PX + RADIUS_PX * np.sin(np.deg2rad(30.0))),
        round(MIDDLE_PX - RADIUS_PX * np.cos(np.deg2rad(30.0))),
    )
    cv2.line(image, (round(MIDDLE_PX), round(MIDDLE_PX)), end, 30, 14, cv2.LINE_AA)
    found = scale_ends(image, MIDDLE_PX, MIDDLE_PX, RADIUS_PX)
    assert found is not None
    assert np.rad2deg(found) == pytest.approx([-90.0, 90.0], abs=1.5)


def test_a_face_without_ticks_or_with_ticks_all_round_tells_nothing() -> None:
    assert scale_ends(face(0.0, 0.0, 0), MIDDLE_PX, MIDDLE_PX, RADIUS_PX) is None
    assert scale_ends(face(-180.0, 174.0, 59), MIDDLE_PX, MIDDLE_PX, RADIUS_PX) is None
    flat = np.full((SIDE_PX, SIDE_PX), 128, np.uint8)
    assert scale_ends(flat, MIDDLE_PX, MIDDLE_PX, RADIUS_PX) is None
