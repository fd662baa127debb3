"""Tests of the mission's step that scans the panel and fits its plane near the expected place."""

from __future__ import annotations

import numpy as np
import pytest

from hal.errors import InvalidRequest, NotFound
from perception.range import fit_plane_near
from tests.perception.range.scenes import PINHOLE, nearest, noisy, plane_depth, sphere_depth

NORMAL = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
POINT = np.array([0.01, -0.02, 0.6])


def panel_with_a_lamp(seed: int) -> np.ndarray:
    panel = plane_depth(PINHOLE, NORMAL, POINT)
    lamp = sphere_depth(PINHOLE, np.array([0.03, 0.02, 0.6]), 0.03)
    depth = noisy(nearest(panel, lamp).depth_m, 0.0008, seed, gross=0.02)
    depth[:, 130:] += 0.09  # a wall beyond the panel's edge, parallel to it
    return depth


def test_the_panel_is_found_from_a_rough_expectation():
    fit = fit_plane_near(
        panel_with_a_lamp(0),
        PINHOLE,
        point_m=POINT + np.array([0, 0, 0.02]),
        normal=-(NORMAL + np.array([0.08, -0.05, 0.0])),
        sigma_offset_m=0.02,
        sigma_angle_rad=0.1,
    )
    assert np.degrees(np.arccos(fit.feature.direction @ NORMAL)) < 0.05
    assert abs((fit.feature.point_m - POINT) @ NORMAL) < 0.0002
    assert 0.6 < fit.sight_share < 0.85


def test_errors_match_the_covariance():
    """Over many scans the mean squared error in units of sigma is near one, for the offset and for both tilts."""
    squares = []
    for seed in range(60):
        fit = fit_plane_near(panel_with_a_lamp(seed), PINHOLE, point_m=POINT, normal=NORMAL)
        f = fit.feature
        offset = (f.point_m - POINT) @ NORMAL / f.sigma_point_m
        turn = np.cross(f.direction, NORMAL)
        tilt2 = turn @ np.linalg.pinv(f.direction_covariance, rcond=1e-6) @ turn
        squares.append([offset**2, tilt2 / 2])
    mean = np.mean(squares, axis=0)
    assert (mean > 0.6).all() and (mean < 1.6).all(), mean


def plate_with_labels(seed: int, height_m: float) -> np.ndarray:
    """Return a scan of a plate with twelve labels that stand out by about the noise of one pixel."""
    depth = plane_depth(PINHOLE, NORMAL, POINT).copy()
    rng = np.random.default_rng(seed)
    for row, column in rng.integers(8, [depth.shape[0] - 24, depth.shape[1] - 24], (12, 2)):
        depth[row : row + 14, column : column + 14] -= height_m
    return noisy(depth, 0.0008, seed, gross=0.02)


def test_labels_that_no_pixel_shows_neither_turn_the_plane_nor_leave_its_covariance_too_small():
    squares = []
    for seed in range(40):
        f = fit_plane_near(plate_with_labels(seed, 0.001), PINHOLE, point_m=POINT, normal=NORMAL).feature
        turn = np.cross(f.direction, NORMAL)
        squares.append(
            [
                ((f.point_m - POINT) @ NORMAL / f.sigma_point_m) ** 2,
                turn @ np.linalg.pinv(f.direction_covariance, rcond=1e-6) @ turn / 2,
            ]
        )
    offset, tilt = np.mean(squares, axis=0)
    assert 0.5 < tilt < 2.0
    assert offset < 4.0


def test_nothing_near_is_said():
    with pytest.raises(NotFound):
        fit_plane_near(panel_with_a_lamp(1), PINHOLE, point_m=[0, 0, 1.5], normal=NORMAL)
    with pytest.raises(NotFound):
        fit_plane_near(panel_with_a_lamp(1), PINHOLE, point_m=POINT, normal=[1, 0, -0.4], sigma_angle_rad=0.05)


@pytest.mark.parametrize(
    "expected", [{"normal": [0, 0, 0]}, {"normal": [0, 1]}, {"point_m": [np.nan, 0, 0]}, {"sigma_offset_m": 0.0}]
)
def test_a_useless_expectation_is_refused(expected):
    arguments = {"point_m": POINT, "normal": NORMAL, **expected}
    with pytest.raises(InvalidRequest):
        fit_plane_near(panel_with_a_lamp(1), PINHOLE, **arguments)
