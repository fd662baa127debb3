"""A wall stays one surface under correlated noise, and if it bulges by less than the noise."""

import cv2
import numpy as np
import pytest

from perception.range import PinholeSensor, analyse

H, W = 240, 320
SENSOR = PinholeSensor(width_px=W, height_px=H, fx_px=290.0, fy_px=290.0, cx_px=159.5, cy_px=119.5)
V, U = np.mgrid[:H, :W]
WALL_M = 3.0 / (1.0 + 0.1 * (U - 159.5) / 290.0)


def noise_m(sigma_px, seed=4):
    """Return 12 mm of noise that is correlated over `sigma_px` pixels."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (H, W))
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma_px) if sigma_px else noise
    return 0.012 * smooth / smooth.std()


@pytest.mark.parametrize("sigma_px", [0.0, 1.5, 4.0])
def test_noise_cuts_no_wall_be_it_slow(sigma_px):
    assert len(analyse(WALL_M + noise_m(sigma_px), SENSOR).surfaces) == 1


def test_a_bulged_wall_has_no_step():
    bulge_m = 0.04 * (1.0 - ((U - 160) / 160.0) ** 2)
    assert len(analyse(WALL_M - bulge_m + noise_m(1.0), SENSOR).surfaces) == 1
