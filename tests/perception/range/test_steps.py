"""Steps below the noise of a pixel: found from means along edges and over faces, and not found where there are none."""

import cv2
import numpy as np
import pytest

from perception.range import PinholeSensor, analyse

H, W = 240, 320
SENSOR = PinholeSensor(width_px=W, height_px=H, fx_px=290.0, fy_px=290.0, cx_px=159.5, cy_px=119.5)
V, U = np.mgrid[:H, :W]
PICTURE = (U >= 120) & (U < 200) & (V >= 60) & (V < 140)
WALL_M = 3.0 / (1.0 + 0.1 * (U - 159.5) / 290.0)


def noise_m(sigma_px, seed=4):
    """12 mm of noise, correlated over `sigma_px` pixels."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (H, W))
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma_px) if sigma_px else noise
    return 0.012 * smooth / smooth.std()


@pytest.mark.parametrize(("sigma_px", "step_m"), [(0.0, 0.024), (1.5, 0.03)])
def test_a_picture_nearer_than_its_wall_by_twice_the_noise_is_a_face(sigma_px, step_m):
    scene = analyse(WALL_M - step_m * PICTURE + noise_m(sigma_px), SENSOR)
    labels, counts = np.unique(scene.labels[PICTURE], return_counts=True)
    mine = scene.labels == labels[counts.argmax()]
    assert np.count_nonzero(mine & PICTURE) > 0.85 * np.count_nonzero(mine | PICTURE)
    picture, wall = (next(s for s in scene.surfaces if s.label == scene.labels[at]) for at in ((100, 160), (200, 160)))
    gap_m = float(wall.primitive.normal @ (picture.primitive.point_m - wall.primitive.point_m))
    assert gap_m == pytest.approx(step_m, abs=0.006)


@pytest.mark.parametrize("sigma_px", [0.0, 1.5, 4.0])
def test_noise_cuts_no_wall_be_it_slow(sigma_px):
    assert len(analyse(WALL_M + noise_m(sigma_px), SENSOR).surfaces) == 1


def test_a_bulged_wall_has_no_step():
    bulge_m = 0.04 * (1.0 - ((U - 160) / 160.0) ** 2)
    assert len(analyse(WALL_M - bulge_m + noise_m(1.0), SENSOR).surfaces) == 1


def test_a_wall_that_a_post_parts_is_one_also_where_a_picture_hangs_on_one_side():
    post = (U >= 205) & (U < 225)
    depth_m = np.where(post, 1.8, WALL_M - 0.03 * PICTURE) + noise_m(0.0)
    labels = analyse(depth_m, SENSOR).labels
    assert labels[30, 40] == labels[30, 290] == labels[210, 290] > 0
    assert labels[100, 160] not in (0, labels[30, 40], labels[100, 215])
