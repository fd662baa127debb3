"""The white, correlated and quantisation parts of an image's noise are measured."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perception.range.noise import estimate_noise
from perception.range.sensor import OrthographicSensor
from tests.perception.range.scenes import PARALLEL, PINHOLE, noisy, plane_depth


@pytest.mark.parametrize("sigma_m", [0.0005, 0.001, 0.003])
@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_white_noise_is_measured(sigma_m, sensor):
    wall = plane_depth(sensor, np.array([0.2, 0.3, -1.0]), np.array([0, 0, 0.6]))
    depth = noisy(wall, sigma_m, seed=3, gross=0.01)
    measured = float(estimate_noise(depth, sensor).sigma_m(0.6))
    assert measured == pytest.approx(sigma_m, rel=0.15)


def test_steps_and_slow_noise_are_told_apart():
    wall = plane_depth(PINHOLE, np.array([0.2, 0.3, -1.0]), np.array([0, 0, 0.6]))
    stepped = np.round(wall / 0.004) * 0.004
    law = estimate_noise(stepped, PINHOLE)
    assert law.step[0] + law.step[1] * 0.36 == pytest.approx(0.004, rel=0.1)
    large = OrthographicSensor(width_px=400, height_px=400, pixel_pitch_m=0.001)
    slow = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (400, 400)), (0, 0), 3.0)
    law = estimate_noise(0.6 + slow * 0.002 / slow.std(), large)
    assert law.slow_share(0.6) > 0.5
