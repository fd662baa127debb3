"""Stereo points and lines: exact views, statistics, and views that cannot tell."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose, certain, perturbed, transform_rpy
from perception.vision.stereo import SeenLine, SeenPoint, Station, stereo_line, stereo_point

LENS = CameraIntrinsics(
    width_px=640, height_px=480, fx_px=610.0, fy_px=606.0, cx_px=325.0, cy_px=236.0,
    distortion=(-0.12, 0.04, 0.0008, -0.0006, 0.0),
)  # fmt: skip
POINT = np.array([0.02, -0.03, 0.6])
END = np.array([0.12, 0.05, 0.64])
LEFT = transform_rpy([-0.08, 0.0, 0.0], [0.02, 0.12, 0.01])
RIGHT = transform_rpy([0.09, 0.01, 0.02], [-0.03, -0.14, 0.05])
ABOVE = transform_rpy([0.0, -0.1, 0.01], [-0.15, 0.0, 0.0])
POSE_COVARIANCE = np.diag([2e-4**2] * 3 + [4e-4**2] * 3)
PIXEL = np.eye(2) * 0.2**2


def pixel(camera: RigidTransform, point: np.ndarray) -> np.ndarray:
    return np.asarray(project(camera.inv().apply(point)[None], LENS)[0])


def seen_points(cameras: list[RigidTransform], rng: np.random.Generator | None = None) -> list[SeenPoint]:
    found = []
    for camera in cameras:
        told, at = camera, pixel(camera, POINT)
        if rng is not None:
            told = perturbed(camera, rng.multivariate_normal(np.zeros(6), POSE_COVARIANCE))
            at = at + rng.normal(scale=0.2, size=2)
        station = Station(base_from_camera=UncertainPose(parent_from_child=told, covariance=POSE_COVARIANCE),
                          intrinsics=LENS)  # fmt: skip
        found.append(SeenPoint(station=station, pixel_px=at, covariance_px=PIXEL))
    return found


def seen_lines(cameras: list[RigidTransform], rng: np.random.Generator | None = None) -> list[SeenLine]:
    found = []
    for k, camera in enumerate(cameras):
        a, b = POINT + 0.1 * k * (END - POINT), END - 0.07 * k * (END - POINT)  # other points in every view
        told, at = camera, np.array([pixel(camera, a), pixel(camera, b)])
        if rng is not None:
            told = perturbed(camera, rng.multivariate_normal(np.zeros(6), POSE_COVARIANCE))
            at = at + rng.normal(scale=0.2, size=(2, 2))
        station = Station(base_from_camera=UncertainPose(parent_from_child=told, covariance=POSE_COVARIANCE),
                          intrinsics=LENS)  # fmt: skip
        found.append(SeenLine(station=station, pixels_px=at, covariance_px=PIXEL))
    return found


def test_exact_views_give_the_exact_point() -> None:
    found = stereo_point(seen_points([LEFT, RIGHT]))
    np.testing.assert_allclose(found.point_m, POINT, atol=1e-9)
    assert found.chi_square < 1e-9
    assert found.degrees == 1


@pytest.mark.parametrize("cameras", [[LEFT, RIGHT], [LEFT, RIGHT, ABOVE]])
def test_point_errors_match_the_covariance(cameras: list[RigidTransform]) -> None:
    rng = np.random.default_rng(1)
    nees, chi = [], []
    for _ in range(200):
        found = stereo_point(seen_points(cameras, rng))
        e = found.point_m - POINT
        nees.append(e @ np.linalg.solve(found.covariance, e) / 3.0)
        chi.append(found.chi_square / found.degrees)
    assert 0.8 < np.mean(nees) < 1.2
    assert 0.7 < np.mean(chi) < 1.3


def test_exact_views_give_the_exact_line() -> None:
    found = stereo_line(seen_lines([LEFT, RIGHT, ABOVE]))
    true = (END - POINT) / np.linalg.norm(END - POINT)
    assert abs(found.direction @ true) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(np.cross(found.point_m - POINT, true)) < 1e-9


@pytest.mark.parametrize("cameras", [[LEFT, ABOVE], [LEFT, RIGHT, ABOVE]])
def test_line_errors_match_the_covariance(cameras: list[RigidTransform]) -> None:
    rng = np.random.default_rng(2)
    true = (END - POINT) / np.linalg.norm(END - POINT)
    nees = []
    for _ in range(200):
        found = stereo_line(seen_lines(cameras, rng))
        v = found.direction * np.sign(found.direction @ true)
        away = POINT - found.point_m
        shift = away - (away @ v) / (true @ v) * true  # to where the true line crosses the plane across the found one
        e = np.concatenate([shift, true / (true @ v) - v])
        if found.direction @ true < 0:
            e[3:] *= -1.0
        nees.append(e @ np.linalg.pinv(found.covariance, rcond=1e-9) @ e / 4.0)
    assert 0.8 < np.mean(nees) < 1.2


def test_the_direction_information_is_that_of_the_covariance() -> None:
    found = stereo_line(seen_lines([LEFT, RIGHT, ABOVE]))
    M = found.direction_information()
    assert np.abs(M @ found.direction).max() < 1e-6 * np.abs(M).max()
    np.testing.assert_allclose(M @ found.covariance[3:, 3:] @ M, M, rtol=1e-6)


def test_parallel_rays_leave_the_depth_free() -> None:
    with pytest.raises(NotObservable, match="depth"):
        stereo_point(seen_points([LEFT, perturbed(LEFT, [1e-4, 0, 0, 0, 0, 0])]))


def test_moving_along_the_edge_does_not_measure_it() -> None:
    along = perturbed(LEFT, np.concatenate([0.5 * (END - POINT), np.zeros(3)]))
    with pytest.raises(NotObservable, match="same plane"):
        stereo_line(seen_lines([LEFT, along]))


def test_two_different_things_are_not_one_point() -> None:
    first, second = seen_points([LEFT, RIGHT])
    moved = SeenPoint(station=second.station, pixel_px=second.pixel_px + np.array([0.0, 15.0]), covariance_px=PIXEL)
    with pytest.raises(NotFound, match="one point"):
        stereo_point([first, moved])


def test_bad_input_is_refused() -> None:
    good = seen_points([LEFT, RIGHT])
    with pytest.raises(InvalidRequest, match="one view"):
        stereo_point(good[:1])
    broken = SeenPoint(station=good[1].station, pixel_px=np.array([np.nan, 3.0]), covariance_px=PIXEL)
    with pytest.raises(InvalidRequest, match=r"seen\[1\]"):
        stereo_point([good[0], broken])
    with pytest.raises(InvalidRequest, match="one view"):
        stereo_line(seen_lines([LEFT]))


def test_a_certain_station_is_allowed() -> None:
    exact = [
        SeenPoint(station=Station(base_from_camera=certain(c), intrinsics=LENS), pixel_px=pixel(c, POINT),
                  covariance_px=PIXEL) for c in (LEFT, RIGHT)
    ]  # fmt: skip
    wide = stereo_point(seen_points([LEFT, RIGHT])).covariance
    assert np.trace(stereo_point(exact).covariance) < np.trace(wide)
