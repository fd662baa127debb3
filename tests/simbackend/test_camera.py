"""Tests of the camera: pixels agree with the lens model, and each corruption has its effect."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from simbackend.arm_model import base_from_flange, t3
from simbackend.camera import scaled
from simbackend.camera_sensor import CameraSensor, SensorOptions
from simbackend.client import true_mount
from simbackend.draws import Draws
from simbackend.wire import Emitter, PictureInfo
from tests.simbackend.rig import SimCell

LENS = CameraIntrinsics(
    width_px=160,
    height_px=120,
    fx_px=115.0,
    fy_px=115.0,
    cx_px=80.2,
    cy_px=58.7,
    distortion=(-0.08, 0.02, 1e-3, -1e-3, 0.0),
)
CLEAN = SensorOptions(
    oversample=2.0,
    blur_px=0.0,
    vignette=0.0,
    full_well_electrons=1e9,
    read_noise_electrons=0.0,
    is_colour=False,
)


def info(*lit: Emitter) -> PictureInfo:
    return PictureInfo(
        tick=0,
        stamp_s=0.0,
        camera_from_base=RigidTransform.identity(),
        base_from_panel=RigidTransform.identity(),
        lit=lit,
    )


def project(points_m: Array, lens: CameraIntrinsics) -> Array:
    """Return pixels by OpenCV, as an independent lens model."""
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    pixels, _ = cv2.projectPoints(
        np.array(points_m, order="C"), np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion)
    )
    return np.asarray(pixels, float).reshape(-1, 2)


def exposed(
    radiance: NDArray[np.float32], options: SensorOptions = CLEAN, *lit: Emitter, exposure_s: float = 0.01
) -> NDArray[np.uint8]:
    return CameraSensor(LENS, options).expose(info(*lit), radiance, exposure_s, np.random.default_rng(0))


def flat(options: SensorOptions = CLEAN, level: float = 0.5) -> NDArray[np.float32]:
    width, height = CameraSensor(LENS, options).drawn
    return np.full((height, width, 1), level, np.float32)


def test_a_spot_of_the_ideal_drawing_lands_where_the_lens_bends_it() -> None:
    sensor = CameraSensor(LENS, CLEAN)
    for x, y in ((0.0, 0.0), (0.45, 0.3), (-0.5, 0.4), (0.3, -0.42)):
        radiance = np.zeros((sensor.drawn[1], sensor.drawn[0], 1), np.float32)
        centre = (sensor.focal[0] * x + sensor.centre[0], sensor.focal[1] * y + sensor.centre[1])
        v, u = np.mgrid[0 : sensor.drawn[1], 0 : sensor.drawn[0]]
        radiance[:, :, 0] = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 4.0**2))
        image = exposed(radiance).astype(float)
        rows, columns = np.mgrid[0:120, 0:160]
        found = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
        np.testing.assert_allclose(found, project(np.array([[x, y, 1.0]]), LENS)[0], atol=0.06)


def test_border_lights_appear_where_truth_lens_and_mount_put_them(bench: SimCell) -> None:
    """Compares the whole chain with OpenCV: panel pose, kinematics, mount, lens, drawing, sensor."""
    lights, camera, arm = bench.connect("panel_lights"), bench.connect("wrist_camera"), bench.connect("arm")

    def picture(on: bool) -> Array:
        lights.set_on([on] * 4, deadline=bench.deadline())
        bench.clock.sleep(0.05)
        return np.asarray(camera.read_image(deadline=bench.deadline()).value.pixels, float)

    difference = picture(True) - picture(False)
    draws = Draws(bench.cell.file.cell.seed)
    record = bench.cell.calibration_of("wrist_camera")
    assert record.intrinsics is not None
    lens = draws.lens("wrist_camera", record.intrinsics.intrinsics())
    q = arm.read_state(deadline=bench.deadline()).value.position_rad
    base_from_camera = base_from_flange(t3().capabilities.links, q) * true_mount(bench.cell, draws, "wrist_camera")
    base_from_panel = RigidTransform.from_matrix(arm.truth().base_from_panel_matrix)
    panel = bench.cell.panel
    built = [
        panel.tolerances.light_m * draws.stream(f"light/{light.name}").standard_normal(3) for light in panel.lights
    ]
    places = np.array([light.position_m for light in panel.lights]) + built
    expected = project((base_from_camera.inv() * base_from_panel).apply(places), lens)
    seen = [p for p in expected if 15 < p[0] < 625 and 15 < p[1] < 465]
    assert len(seen) >= 2, expected
    rows, columns = np.mgrid[0:480, 0:640]
    for u, v in seen:
        near = np.hypot(columns - u, rows - v) < 14
        weight = np.where(near, np.clip(difference - 80.0, 0.0, 40.0), 0.0)
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, [u, v], atol=0.15)


def test_grey_levels_follow_radiance_and_exposure() -> None:
    assert np.all(np.abs(exposed(flat()).astype(int) - 128) <= 1)
    assert np.all(exposed(flat(), exposure_s=0.02) == 255)
    assert np.all(np.abs(exposed(flat(), exposure_s=0.005).astype(int) - 64) <= 1)


def test_shot_noise_grows_with_the_root_of_the_light() -> None:
    noisy = replace(CLEAN, full_well_electrons=2000.0)
    bright, dark = exposed(flat(noisy, 0.8), noisy).std(), exposed(flat(noisy, 0.2), noisy).std()
    assert bright / dark == pytest.approx(2.0, rel=0.05)
    assert bright == pytest.approx(255.0 * np.sqrt(0.8 / 2000.0), rel=0.05)


def test_the_vignette_darkens_the_corners_and_not_the_middle() -> None:
    shaded = replace(CLEAN, vignette=1.0)
    image = exposed(flat(shaded), shaded).astype(int)
    assert abs(image[58, 80] - 128) <= 1
    assert image[0, 0] < 0.75 * 128


def test_a_border_light_brightens_the_plate_round_it() -> None:
    lamp = Emitter(colour=(1.0, 1.0, 1.0), position_m=(0.0, 0.0, 0.5), radius_m=0.008, is_border_light=True)
    gain = exposed(flat(level=0.3), CLEAN, lamp).astype(int) - exposed(flat(level=0.3)).astype(int)
    near, far = gain[58, 84], gain[10, 20]
    assert near > 15
    assert 0 <= far < near / 3


def test_a_colour_camera_gives_three_channels(bench: SimCell) -> None:
    camera = bench.connect("wrist_camera", colour=True)
    image = camera.read_image(deadline=bench.deadline()).value.pixels
    assert image.shape == (480, 640, 3)
    assert np.abs(image[:, :, 0].astype(int) - image[:, :, 2]).max() > 60  # something red or blue is visible


def test_a_rescaled_lens_sees_the_same_field() -> None:
    large = scaled(LENS, 320, 240)
    corner = np.array([[-0.6, -0.4, 1.0]])
    np.testing.assert_allclose(project(corner, large) + 0.5, 2.0 * (project(corner, LENS) + 0.5), atol=1e-9)
