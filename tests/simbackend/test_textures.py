"""Tests of the printed textures: ticks at the right angle, digits with separate segments, marks on the plate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hal.arrays import Array
from hal.panel import Display, Gauge, Scale, load_panel
from simbackend import textures
from simbackend.bodies.display import SEGMENTS, display_face
from simbackend.bodies.gauge import gauge_face
from tests.simbackend.rig import ROOT

TABLE = ((-1.2, 20.0), (0.6, 60.0))
GAUGE = Gauge(
    name="g",
    position_m=(0.0, 0.0),
    radius_m=0.036,
    scale=Scale(minimum=0.0, maximum=100.0, unit="bar", at_min=-2.2, at_max=2.2, major_ticks=6, table=TABLE),
)


def grey(pixels: NDArray[np.uint8]) -> Array:
    return np.asarray(pixels, float).mean(axis=2)


def at_angle(face: Array, angle_rad: float, radius_ratio: float) -> float:
    """Return the gray level at an angle clockwise from straight up."""
    half = len(face) / 2
    x, y = half * (1 + radius_ratio * np.sin(angle_rad)), half * (1 - radius_ratio * np.cos(angle_rad))
    return float(face[round(y - 0.5), round(x - 0.5)])


def test_major_ticks_stand_where_the_scale_puts_its_values() -> None:
    face = grey(gauge_face(GAUGE))
    for value in np.linspace(0.0, 100.0, 6):
        assert at_angle(face, GAUGE.scale.place_of(float(value)), 0.78) < 120, value
    assert at_angle(face, np.pi, 0.78) > 200  # the gap at the bottom


def test_the_face_has_a_dark_rim_and_a_white_ground() -> None:
    face = grey(gauge_face(GAUGE))
    assert at_angle(face, 0.3, 0.96) < 60
    assert at_angle(face, np.pi, 0.2) > 220


@pytest.mark.parametrize("digit", "0123456789")
def test_every_digit_lights_its_own_segments(digit: str) -> None:
    panel_object = Display(name="d", position_m=(0.0, 0.0), width_m=0.03, height_m=0.04, digits=1)
    face = grey(display_face(panel_object, digit))
    lit = np.count_nonzero(face > 80)
    full = np.count_nonzero(grey(display_face(panel_object, "8")) > 80)
    expected = len(SEGMENTS[digit]) / 7
    assert lit / full == pytest.approx(expected, abs=0.05)


def test_ten_digits_make_ten_pictures() -> None:
    panel_object = Display(name="d", position_m=(0.0, 0.0), width_m=0.03, height_m=0.04, digits=1)
    assert len({display_face(panel_object, str(digit)).tobytes() for digit in range(10)}) == 10


def test_the_plate_is_light_and_printed(tmp_path: Path) -> None:
    panel = load_panel(ROOT / "panels" / "bench.toml")
    plate = grey(textures.plate(panel, (panel.width_m, panel.height_m), (0.0, 0.0)))
    assert plate.shape == (round(panel.height_m * 2600), round(panel.width_m * 2600))
    assert np.median(plate) > 190
    assert 0.01 < np.mean(plate < 90) < 0.15
