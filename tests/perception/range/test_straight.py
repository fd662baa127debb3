"""A wrong sensor model is reported, a right one is not."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range import OrthographicSensor, PinholeSensor
from perception.range.straight import DISTANCE, PARALLEL, PINHOLE, doubt_about
from tests.perception.range.scenes import plane_depth

SIDE = 128
PINHOLE_SENSOR = PinholeSensor(width_px=SIDE, height_px=SIDE, fx_px=140.0, fy_px=140.0, cx_px=63.5, cy_px=63.5)
PARALLEL_SENSOR = OrthographicSensor(width_px=SIDE, height_px=SIDE, pixel_pitch_m=0.006)


def tilted(sensor, sigma_m: float = 0.0005) -> np.ndarray:
    """Return two walls that meet in a crease."""
    walls = [plane_depth(sensor, np.array([s * 0.6, 0.2, -1.0]), np.array([0.0, 0.0, 1.0])) for s in (1.0, -1.0)]
    return np.min(walls, axis=0) + np.random.default_rng(0).normal(0.0, sigma_m, (SIDE, SIDE))


@pytest.mark.parametrize("sensor", [PINHOLE_SENSOR, PARALLEL_SENSOR], ids=["pinhole", "parallel"])
@pytest.mark.parametrize("sigma_m", [0.0, 0.0005])
def test_the_right_model_is_not_doubted(sensor, sigma_m):
    assert doubt_about(tilted(sensor, sigma_m), sensor) is None


def test_the_other_projection_is_named():
    assert PARALLEL in str(doubt_about(tilted(PARALLEL_SENSOR), PINHOLE_SENSOR))
    assert PINHOLE in str(doubt_about(tilted(PINHOLE_SENSOR), PARALLEL_SENSOR))


def test_distance_along_the_ray_in_place_of_depth_is_named():
    x = (np.arange(SIDE) - 63.5) / 140.0
    slant = tilted(PINHOLE_SENSOR) * np.sqrt(x**2 + x[:, None] ** 2 + 1.0)
    assert DISTANCE in str(doubt_about(slant, PINHOLE_SENSOR))


@pytest.mark.parametrize("depth", [np.full((SIDE, SIDE), 0.8), np.full((SIDE, SIDE), np.nan)], ids=["flat", "empty"])
def test_what_does_not_tell_raises_no_doubt(depth):
    assert doubt_about(depth, PINHOLE_SENSOR) is None


def test_an_image_smaller_than_a_window_raises_no_doubt():
    tiny = PinholeSensor(width_px=5, height_px=5, fx_px=9.0, fy_px=9.0, cx_px=2.0, cy_px=2.0)
    assert doubt_about(np.ones((5, 5)), tiny) is None
