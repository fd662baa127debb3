"""Tests of intrinsics from boards and lights: simulated views, drawn boards, OpenCV as reference, observability."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hal.calibration import CameraIntrinsics
from hal.camera_model import disc_offset_px, project, undistort_pixels
from hal.errors import InvalidRequest, NotFound, NotObservable
from perception.calibration.boards import BoardView, Charuco, Dots
from perception.calibration.intrinsics import LIGHTS_FREE, NAMES, CameraCalibration, calibrate_camera, parameters

TRUE = CameraIntrinsics(
    width_px=640, height_px=480, fx_px=610.0, fy_px=606.0, cx_px=325.0, cy_px=236.0,
    distortion=(-0.12, 0.04, 0.0008, -0.0006, 0.0),
)  # fmt: skip
STRAIGHT = CameraIntrinsics(width_px=640, height_px=480, fx_px=610.0, fy_px=606.0, cx_px=325.0, cy_px=236.0)
DOTS = Dots(columns=8, rows=6, spacing_m=0.03).points_m()
LIGHTS = np.array([[-0.2, 0.13, 0.0], [0.2, 0.13, 0.0], [0.2, -0.13, 0.0], [-0.2, -0.13, 0.0]])


def views(
    points: np.ndarray, count: int, *, seed: int, sigma_px: float = 0.1, tilt_deg: float = 35.0,
    range_m: tuple[float, float] = (0.35, 0.6),
) -> list[BoardView]:  # fmt: skip
    rng = np.random.default_rng(seed)
    made: list[BoardView] = []
    while len(made) < count:
        R = Rotation.from_euler("xyz", rng.uniform(-1, 1, 3) * [tilt_deg, tilt_deg, 40.0], degrees=True)
        t = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(*range_m)])
        pixels = project(R.apply(points - points.mean(axis=0)) + t, TRUE)
        if np.isfinite(pixels).all() and (pixels > 0).all() and (pixels < [640, 480]).all():
            pixels = pixels + rng.normal(scale=sigma_px, size=pixels.shape)
            made.append(BoardView(points_m=points, pixels_px=pixels, sigma_px=sigma_px))
    return made


def errors(result: CameraCalibration) -> np.ndarray:
    found, true = (np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px, *c.distortion]) for c in (result.intrinsics, TRUE))
    return np.asarray((found - true)[[NAMES.index(name) for name in result.names]])


def test_exact_views_give_the_exact_camera() -> None:
    result = calibrate_camera(views(DOTS, 8, seed=1, sigma_px=1e-9), (640, 480))
    assert np.abs(errors(result)).max() < 1e-3
    assert result.rms_px < 1e-6


def test_errors_match_the_covariance() -> None:
    nees = []
    for seed in range(12):
        result = calibrate_camera(views(DOTS, 10, seed=100 + seed), (640, 480))
        e = errors(result)
        nees.append(e @ np.linalg.solve(result.covariance, e) / len(e))
        assert result.chi_square == pytest.approx(result.degrees, rel=0.2)
    assert 0.6 < np.mean(nees) < 1.5


def test_it_agrees_with_opencv() -> None:
    made = views(DOTS, 10, seed=3)
    result = calibrate_camera(made, (640, 480))
    _, matrix, lens, *_ = cv2.calibrateCamera(
        [v.points_m.astype(np.float32) for v in made], [v.pixels_px.astype(np.float32) for v in made], (640, 480),
        None, None, flags=cv2.CALIB_FIX_K3,
    )  # fmt: skip
    ours = result.intrinsics
    np.testing.assert_allclose([ours.fx_px, ours.fy_px, ours.cx_px, ours.cy_px],
                               [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], atol=0.05)  # fmt: skip
    np.testing.assert_allclose(ours.distortion[:4], lens.ravel()[:4], atol=2e-3)


def test_the_cubic_correction_reports_its_bias() -> None:
    result = calibrate_camera(views(DOTS, 15, seed=4), (640, 480))
    grid = np.stack(np.meshgrid(np.linspace(40, 600, 9), np.linspace(40, 440, 7)), axis=-1).reshape(-1, 2)
    miss = result.cubic.ideal(grid) - undistort_pixels(grid, TRUE)
    rms = float(np.sqrt(np.mean(np.sum(miss**2, axis=1))))
    assert rms < 3.0 * result.cubic.bias_px + 0.1
    assert 0.01 < result.cubic.bias_px < 2.0  # more data would not remove it


def test_the_panels_own_lights_are_a_board() -> None:
    result = calibrate_camera(views(LIGHTS, 25, seed=5, sigma_px=0.1, range_m=(0.5, 0.9)), (640, 480), free=LIGHTS_FREE)
    assert abs(result.intrinsics.fx_px - TRUE.fx_px) < 4.0 * np.sqrt(result.covariance[0, 0]) + 2.0
    assert result.names == LIGHTS_FREE


def test_frontal_views_do_not_tell_the_focal_length() -> None:
    with pytest.raises(NotObservable) as refused:
        calibrate_camera(views(DOTS, 6, seed=6, tilt_deg=0.3, range_m=(0.5, 0.501)), (640, 480))
    assert "tilt the board" in refused.value.hint


@pytest.mark.parametrize("change", ["few", "unknown", "nan", "three points"])
def test_bad_input_is_refused(change: str) -> None:
    made = views(DOTS, 5, seed=7)
    free: tuple[str, ...] = ("fx", "fy")
    if change == "few":
        made = made[:2]
    if change == "unknown":
        free = ("fx", "focus")
    if change == "nan":
        made[1].pixels_px[0, 0] = np.nan
    if change == "three points":
        made[0] = BoardView(points_m=DOTS[:3], pixels_px=np.ones((3, 2)), sigma_px=0.1)
    with pytest.raises(InvalidRequest):
        calibrate_camera(made, (640, 480), free=free)


def drawn(texture: np.ndarray, size_m: tuple[float, float], seed: int) -> np.ndarray:
    """Return an image of the flat texture, tilted at random, on a bright wall."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_euler("xyz", rng.uniform(-1, 1, 3) * [30, 30, 15], degrees=True)
    t = np.array([rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.03), rng.uniform(0.45, 0.6)])
    corners = np.array([[0, 0, 0], [size_m[0], 0, 0], [size_m[0], size_m[1], 0], [0, size_m[1], 0]])
    pixels = project(R.apply(corners - corners.mean(axis=0)) + t, STRAIGHT)
    h, w = texture.shape
    edge = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]], np.float32)
    H = cv2.getPerspectiveTransform(edge, (2.0 * pixels + 0.5).astype(np.float32))
    large = cv2.warpPerspective(texture, H, (1280, 960), flags=cv2.INTER_AREA, borderValue=235)
    return np.asarray(cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA))


def test_a_drawn_charuco_board_calibrates_the_camera() -> None:
    board = Charuco()
    texture = board.draw(80)
    size = (board.columns * board.square_m, board.rows * board.square_m)
    noise = np.random.default_rng(1)
    found = []
    for seed in range(10):
        blurred = cv2.GaussianBlur(drawn(texture, size, seed), (0, 0), 0.7).astype(float)
        found.append(board.find(np.clip(blurred + noise.normal(0.0, 3.0, blurred.shape), 0, 255).astype(np.uint8)))
    assert np.mean([len(view.points_m) for view in found]) > 35  # of 40, with markers of 25 pixels
    result = calibrate_camera(found, (640, 480))
    assert result.rms_px < 0.12
    assert result.chi_square < 1.5 * result.degrees
    error = parameters(result.intrinsics) - parameters(STRAIGHT)
    assert np.all(np.abs(error[:4]) < 4.0 * np.sqrt(np.diag(result.covariance)[:4]))


def test_one_stray_point_does_not_bend_the_camera() -> None:
    made = views(DOTS, 8, seed=9)
    clean = calibrate_camera(made, (640, 480))
    made[3].pixels_px[5] += [9.0, -4.0]
    result = calibrate_camera(made, (640, 480))
    sigma = np.sqrt(np.diag(clean.covariance))
    assert np.all(np.abs(parameters(result.intrinsics) - parameters(clean.intrinsics))[:8] < sigma)
    assert [len(r) for r in result.residuals_px][3] == len(DOTS) - 1


def test_more_scatter_than_stated_makes_the_lens_as_much_less_certain() -> None:
    made = [replace(view, sigma_px=view.sigma_px / 3.0) for view in views(DOTS, 8, seed=9)]
    sure, true = calibrate_camera(made, (640, 480)), calibrate_camera(views(DOTS, 8, seed=9), (640, 480))
    assert np.sqrt(sure.covariance[0, 0]) == pytest.approx(np.sqrt(true.covariance[0, 0]), rel=0.15)


def test_a_drawn_dot_board_calibrates_the_camera() -> None:
    board, scale, radius_m = Dots(columns=7, rows=5, spacing_m=0.035), 3000.0, 0.011
    size = (0.035 * 8, 0.035 * 6)
    texture = np.full((round(size[1] * scale), round(size[0] * scale)), 235, np.uint8)
    for x, y, _ in board.points_m() + 0.035:
        cv2.circle(texture, (round(x * scale), round(y * scale)), round(radius_m * scale), 20, -1)
    found = [board.find(drawn(texture, size, 50 + seed)) for seed in range(10)]
    assert [view.disc_m for view in found] == pytest.approx([radius_m] * 10, rel=0.02)
    result = calibrate_camera(found, (640, 480))
    assert abs(result.intrinsics.fx_px - STRAIGHT.fx_px) < 6.0


def test_the_middle_of_a_discs_image_is_not_taken_for_the_image_of_its_middle() -> None:
    made = views(DOTS, 8, seed=9)
    plain = calibrate_camera(made, (640, 480))
    for k, (view, pose) in enumerate(zip(made, plain.board_poses, strict=True)):
        offset_px = disc_offset_px(view.points_m, 0.012, pose, plain.intrinsics)
        made[k] = replace(view, pixels_px=view.pixels_px + offset_px, disc_m=0.012)
    result = calibrate_camera(made, (640, 480))
    ignored = calibrate_camera([replace(view, disc_m=0.0) for view in made], (640, 480))
    focal = [c.intrinsics.fx_px - plain.intrinsics.fx_px for c in (result, ignored)]
    assert abs(focal[0]) < 0.1 * abs(focal[1])


def test_a_board_that_is_not_there_is_not_found() -> None:
    empty = np.full((480, 640), 128, np.uint8)
    with pytest.raises(NotFound, match="ChArUco"):
        Charuco().find(empty)
    with pytest.raises(NotFound, match="dots"):
        Dots().find(empty)
