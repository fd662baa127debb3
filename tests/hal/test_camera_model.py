"""Compares the camera model with OpenCV's, its derivatives with finite differences, and tests its inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from hal.calibration import CameraIntrinsics
from hal.camera_model import (
    check_size,
    disc_offset_px,
    normalised_with_jacobian,
    project,
    project_with_jacobian,
    rays,
    undistort_pixels,
)
from hal.errors import InvalidRequest
from hal.geometry import transform_rpy

LENS = CameraIntrinsics(
    width_px=640, height_px=480, fx_px=620.0, fy_px=615.0, cx_px=322.0, cy_px=236.0,
    distortion=(-0.25, 0.08, 0.001, -0.0015, -0.01),
)  # fmt: skip
IDEAL = CameraIntrinsics(width_px=640, height_px=480, fx_px=620.0, fy_px=615.0, cx_px=322.0, cy_px=236.0)


def some_points(seed: int, count: int = 50) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.4, 0.4, count), rng.uniform(-0.3, 0.3, count), rng.uniform(0.6, 2.0, count)])


def test_projection_agrees_with_opencv() -> None:
    points = some_points(1)
    matrix = np.array([[LENS.fx_px, 0, LENS.cx_px], [0, LENS.fy_px, LENS.cy_px], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(LENS.distortion))
    np.testing.assert_allclose(project(points, LENS), theirs.reshape(-1, 2), atol=1e-9)


def test_jacobian_agrees_with_finite_differences() -> None:
    points = some_points(2, 10)
    pixels, jacobian = project_with_jacobian(points, LENS)
    np.testing.assert_allclose(pixels, project(points, LENS))
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (project(points + step, LENS) - project(points - step, LENS)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, axis], numeric, rtol=1e-6, atol=1e-4)


def test_a_point_behind_the_camera_has_no_pixel() -> None:
    pixels = project([[0.0, 0.0, 1.0], [0.1, 0.1, -1.0], [0.0, 0.0, 0.0]], LENS)
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()


@settings(max_examples=60, deadline=None)
@given(u=st.floats(0, 639), v=st.floats(0, 479), k1=st.floats(-0.2, 0.3), k2=st.floats(-0.02, 0.05),
       p1=st.floats(-0.002, 0.002), p2=st.floats(-0.002, 0.002))  # fmt: skip
def test_a_ray_projects_back_onto_its_pixel(u: float, v: float, k1: float, k2: float, p1: float, p2: float) -> None:
    lens = CameraIntrinsics(width_px=640, height_px=480, fx_px=620.0, fy_px=615.0, cx_px=322.0, cy_px=236.0,
                            distortion=(k1, k2, p1, p2, 0.0))  # fmt: skip
    direction = rays([[u, v]], lens)
    assert abs(np.linalg.norm(direction) - 1.0) < 1e-12
    np.testing.assert_allclose(project(2.5 * direction, lens), [[u, v]], atol=1e-8)


def test_the_inverse_jacobian_agrees_with_finite_differences() -> None:
    pixels = np.array([[30.0, 40.0], [600.0, 420.0], [320.0, 240.0]])
    _, jacobian = normalised_with_jacobian(pixels, LENS)
    for axis in range(2):
        step = 1e-4 * np.eye(2)[axis]
        ahead, back = (normalised_with_jacobian(pixels + s, LENS)[0] for s in (step, -step))
        np.testing.assert_allclose(jacobian[:, :, axis], (ahead - back) / 2e-4, rtol=1e-5, atol=1e-10)


def test_a_pixel_beyond_the_fold_of_the_lens_is_not_a_number() -> None:
    folding = CameraIntrinsics(width_px=2000, height_px=2000, fx_px=600.0, fy_px=600.0, cx_px=1000.0, cy_px=1000.0,
                               distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    ideal = undistort_pixels([[1100.0, 1000.0], [1990.0, 1000.0]], folding)  # no inverse beyond r_d = 0.70, 422 px
    assert np.isfinite(ideal[0]).all()
    assert np.isnan(ideal[1]).all()


def test_an_image_of_another_size_is_refused_by_name() -> None:
    with pytest.raises(InvalidRequest, match="320x240"):
        check_size(np.zeros((240, 320), np.uint8), LENS)


@pytest.mark.parametrize("wrong", [[1.0, 2.0, 3.0], [[1.0, 2.0]], np.zeros((2, 2, 3))])
def test_points_of_a_wrong_shape_are_refused(wrong: object) -> None:
    with pytest.raises(InvalidRequest, match=r"\(N, 3\)"):
        project(wrong, LENS)


def test_a_discs_image_has_its_middle_where_adding_up_its_points_says() -> None:
    camera_from_plate: RigidTransform = transform_rpy([0.02, -0.03, 0.4], [np.pi - 0.7, 0.4, 0.1])
    middles, radius_m = np.array([[-0.15, 0.1, 0.01], [0.12, 0.08, 0.0], [0.0, 0.0, 0.0]]), 0.02
    x, y = np.meshgrid(*[np.linspace(-1, 1, 401)] * 2)
    disc = radius_m * np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])[x.ravel() ** 2 + y.ravel() ** 2 <= 1.0]
    for middle, offset_px in zip(middles, disc_offset_px(middles, radius_m, camera_from_plate, IDEAL), strict=True):
        seen = camera_from_plate.apply(middle + disc)
        area = seen[:, 2] ** -3.0  # image area of a surface element of a plane, up to a constant factor
        mean = (area @ project(seen, IDEAL)) / area.sum()
        assert np.allclose(offset_px, mean - project(camera_from_plate.apply(middle)[None], IDEAL)[0], atol=0.02 * 0.5)
        assert np.linalg.norm(offset_px) > 0.2
