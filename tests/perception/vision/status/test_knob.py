"""Knobs drawn at known angles: the value at the mark is read, and knobs without mark are refused."""

from __future__ import annotations

import numpy as np
import pytest

from hal.panel import Scale
from hal.panel.knob import Knob
from perception.vision.patch import Patch
from perception.vision.status.knob import read_knob

KNOB = Knob(
    name="dose", position_m=(0.0, 0.0), scale=Scale(minimum=0.0, maximum=10.0, unit="ml", at_min=-2.3562, at_max=2.3562)
)
PX_PER_M, SIDE = 4000.0, 200


def patch_of(angle_rad: float | None, seed: int = 0) -> Patch:
    """Draw a dark knob on a bright plate, with a bright mark at an angle, and noise."""
    v, u = np.mgrid[:SIDE, :SIDE]
    x, y = (u - (SIDE - 1) / 2) / PX_PER_M, -(v - (SIDE - 1) / 2) / PX_PER_M
    r = np.hypot(x, y)
    picture = np.where(r < KNOB.radius_m, 40.0, 200.0)
    if angle_rad is not None:
        along = x * np.sin(angle_rad) + y * np.cos(angle_rad)
        across = x * np.cos(angle_rad) - y * np.sin(angle_rad)
        on_mark = (
            (np.abs(across) < 0.06 * KNOB.radius_m) & (0.2 * KNOB.radius_m < along) & (along < 0.95 * KNOB.radius_m)
        )
        picture[on_mark] = 230.0
    noisy = picture + np.random.default_rng(seed).normal(0.0, 3.0, picture.shape)
    gray = np.clip(noisy, 0, 255).astype(np.uint8)
    middle = (SIDE - 1) / 2
    return Patch(
        gray=gray, colour=None, inside=np.ones_like(gray, bool), px_per_m=PX_PER_M, origin_px=np.array([middle, middle]),
        plane_z_m=KNOB.height_m, parallax_px_per_m=np.zeros(2), growth_per_m=0.0, image_px_per_m=PX_PER_M,
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_a_knob_is_read_to_two_per_cent_wherever_it_points(seed: int) -> None:
    value = float(np.random.default_rng(seed).uniform(0.0, 10.0))
    reading = read_knob(patch_of(KNOB.scale.place_of(value), seed), KNOB)
    assert reading.reason is None
    assert reading.value == pytest.approx(value, abs=0.2)


def test_a_knob_without_a_mark_is_not_read() -> None:
    assert read_knob(patch_of(None), KNOB).reason is not None
