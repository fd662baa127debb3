"""A bright numeral that touches a dim pointer on a dark face must neither turn the pointer nor replace it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from perception.vision.patch import Patch
from perception.vision.status.pointer import PointerSearch, find_pointer

SIZE, RADIUS_M, PX_PER_M = 240, 0.045, 2200.0


def face(angle_rad: float, seed: int) -> Patch:
    """Draw a dark face with a dim pointer, and a bright numeral 8 degrees beside it."""
    middle = np.full(2, SIZE / 2)
    picture = np.full((SIZE, SIZE), 35.0, np.float32)
    R = RADIUS_M * PX_PER_M

    def towards(angle: float, share: float) -> np.ndarray:
        return middle + share * R * np.array([np.sin(angle), -np.cos(angle)])

    side = 0.05 * R * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    pointer = np.array([middle + side, towards(angle_rad, 0.78), middle - side])
    cv2.fillPoly(picture, [np.round(pointer * 16).astype(np.int32)], 65.0, cv2.LINE_AA, shift=4)
    numeral = towards(angle_rad - np.deg2rad(8.0), 0.54)
    cv2.circle(picture, tuple(np.round(numeral).astype(int).tolist()), round(0.07 * R), 220.0, -1, cv2.LINE_AA)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.5) + noise), 0, 255).astype(np.uint8)
    return Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=PX_PER_M, image_px_per_m=PX_PER_M / 1.5,
        origin_px=middle, parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("angle_deg", [-100.0, 20.0, 100.0])
def test_a_bright_numeral_beside_a_dim_pointer_does_not_turn_it(angle_deg: float) -> None:
    R = RADIUS_M
    for seed in range(3):
        search = PointerSearch(pivot_m=(0.0, 0.0), inner_m=0.25 * R, outer_m=0.6 * R, fine_m=(0.25 * R, 0.72 * R))
        fit = find_pointer(face(float(np.deg2rad(angle_deg)), seed), search)
        assert fit is not None and not fit.is_dark
        assert np.rad2deg(fit.angle_rad) == pytest.approx(angle_deg, abs=1.2)


@pytest.mark.parametrize("angle_deg", [-100.0, 20.0, 100.0])
def test_bright_numerals_that_do_not_reach_the_hub_are_no_pointer(angle_deg: float) -> None:
    """The numeral 10 at the end of the scale must not be taken for the pointer, or 4.5 bar is read as 9.9."""
    R, angle_rad = RADIUS_M, float(np.deg2rad(angle_deg))
    patch = face(angle_rad, 0)
    middle, numerals = np.full(2, SIZE / 2), angle_rad + np.pi / 2
    towards = np.array([np.sin(numerals), -np.cos(numerals)]) * R * PX_PER_M
    ends = [np.round(16 * (middle + share * towards)).astype(int).tolist() for share in (0.36, 0.62)]
    picture = cv2.line(patch.gray.copy(), *ends, 220, 7, cv2.LINE_AA, 4)
    search = PointerSearch(
        pivot_m=(0.0, 0.0), inner_m=0.25 * R, outer_m=0.6 * R, fine_m=(0.25 * R, 0.48 * R), from_hub=True
    )
    fit = find_pointer(replace(patch, gray=cv2.GaussianBlur(picture, (0, 0), 1.0)), search)
    assert fit is not None
    assert np.rad2deg(fit.angle_rad) == pytest.approx(angle_deg, abs=3.0)
