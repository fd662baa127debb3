"""Tests of finding lights in an on/off pair: drawn pairs with known truth, stored pairs, and every refusal."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.pose_lights import drawn_pairs, seen_lights, stored_pairs
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import InvalidRequest, NotFound, PerceptionError
from hal.geometry import transform, transform_rpy
from perception.vision.lights import CameraMoved, LightMissing, WrongLamp, assign_lights, find_lights, find_panel
from perception.vision.lights.alignment import register
from perception.vision.lights.panel_finder import PanelPrior

CAMERA = CameraIntrinsics(width_px=640, height_px=480, fx_px=700.0, fy_px=700.0, cx_px=319.5, cy_px=239.5)
LIGHTS = np.array([[-0.2, 0.12, 0.0], [0.2, 0.12, 0.0], [0.2, -0.12, 0.0], [-0.2, -0.12, 0.0]])
FRONT = np.diag([1.0, -1.0, -1.0])
R_TRUE = Rotation.from_euler("xyz", [8.0, -12.0, 4.0], degrees=True).as_matrix() @ FRONT
T_TRUE = np.array([0.01, -0.005, 0.62])


def scene(seed: int) -> NDArray[np.float32]:
    """Return a textured panel without lights."""
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 110.0, np.float32)
    for _ in range(40):
        x, y = rng.integers(60, 580), rng.integers(60, 420)
        cv2.rectangle(image, (int(x), int(y)), (int(x + rng.integers(8, 50)), int(y + rng.integers(8, 40))),
                      float(rng.uniform(20, 220)), -1)  # fmt: skip
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8))


def disc(image: NDArray[np.float32], centre_px: Array, radius_px: float, rise: float) -> None:
    """Draw an anti-aliased disc in place."""
    v, u = np.mgrid[:480, :640]
    away = np.hypot(u - centre_px[0], v - centre_px[1])
    image += (rise * np.clip(radius_px + 0.5 - away, 0.0, 1.0)).astype(np.float32)


def shot(image: NDArray[np.float32], seed: int, noise: float = 1.5) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return np.clip(np.round(image + noise * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def light_pixels(R: Array = R_TRUE, t: Array = T_TRUE) -> Array:
    return project(LIGHTS @ R.T + t, CAMERA)


def pair(
    *, leave_out: tuple[int, ...] = (), others: tuple[tuple[float, float], ...] = (), rise: float = 70.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:  # fmt: skip
    off, on = scene(3), scene(3)
    for k, place in enumerate(light_pixels()):
        if k not in leave_out:
            disc(on, place, 5.5, rise)
    for place in others:
        disc(on, np.array(place), 5.5, rise)
    back = np.array([[1.0, 0.0, -shift_px[0]], [0.0, 1.0, -shift_px[1]]])
    off = cv2.warpAffine(off, back, (640, 480), borderMode=cv2.BORDER_REFLECT)
    return shot(np.asarray(off), 1), shot(on, 2)


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (2.6, -1.7), (-9.3, 6.4)])
def test_the_pose_comes_out_of_two_images_although_the_camera_moved(shift_px: tuple[float, float]) -> None:
    images = pair(shift_px=shift_px)
    seen = find_panel(*images, LIGHTS, CAMERA)
    np.testing.assert_allclose(seen.lights.points_px, light_pixels(), atol=0.15)
    np.testing.assert_allclose(find_lights(*images).shift_px, shift_px, atol=0.1)
    assert np.degrees(Rotation.from_matrix(seen.pose.rotation @ R_TRUE.T).magnitude()) < 0.5
    np.testing.assert_allclose(seen.pose.translation_m, T_TRUE, atol=2e-3)


def test_colour_images_work_too() -> None:
    off, on = (np.repeat(image[:, :, None], 3, axis=2) for image in pair())
    np.testing.assert_allclose(find_panel(off, on, LIGHTS, CAMERA).lights.points_px, light_pixels(), atol=0.15)


def test_centres_err_as_their_covariance_says() -> None:
    errors = []
    for seed in range(12):
        off, on = scene(seed), scene(seed)
        places = np.random.default_rng(seed).uniform([60, 60], [580, 420], (4, 2))
        for place in places:
            disc(on, place, 5.0, 30.0)
        blobs = find_lights(shot(off, 100 + seed, 3.0), shot(on, 200 + seed, 3.0))
        for place in places:
            k = int(np.argmin(np.linalg.norm(blobs.centres_px - place, axis=1)))
            e = blobs.centres_px[k] - place
            if np.linalg.norm(e) < 2.0:
                errors.append(e @ np.linalg.solve(blobs.covariance_px[k], e) / 2.0)
    assert len(errors) > 40
    assert 0.2 < np.median(errors) / 0.69 < 3.0  # the median of chi-square with 2 dof, divided by 2, is 0.69


def test_a_missing_light_is_refused_by_its_number() -> None:
    with pytest.raises(LightMissing, match="light 2 ") as refused:
        find_panel(*pair(leave_out=(2,)), LIGHTS, CAMERA)
    assert refused.value.details["missing"] == "2"


def test_three_lights_are_named_when_three_are_enough() -> None:
    blobs = find_lights(*pair(leave_out=(1,)))
    lights = assign_lights(blobs, LIGHTS, image_size_px=(640, 480), intrinsics=CAMERA, least=3)
    assert lights.seen.tolist() == [True, False, True, True]
    assert np.isnan(lights.points_px[1]).all()
    np.testing.assert_allclose(lights.points_px[[0, 2, 3]], light_pixels()[[0, 2, 3]], atol=0.2)


def test_lights_that_do_not_switch_are_refused() -> None:
    with pytest.raises(LightMissing, match="0 lamp-like blobs"):
        find_panel(*pair(leave_out=(0, 1, 2, 3)), LIGHTS, CAMERA)


def test_other_lamps_do_not_mislead_the_choice() -> None:
    images = pair(others=((200.0, 200.0), (330.0, 260.0), (420.0, 180.0), (300.0, 330.0)))
    seen = find_panel(*images, LIGHTS, CAMERA)
    np.testing.assert_allclose(seen.lights.points_px, light_pixels(), atol=0.2)
    assert len(find_lights(*images)) >= 8


def test_a_wrong_lamp_in_place_of_a_light_is_never_taken() -> None:
    wrong = tuple(light_pixels()[2] + [-60.0, -45.0])
    with pytest.raises((LightMissing, WrongLamp)):
        find_panel(*pair(leave_out=(2,), others=(wrong,)), LIGHTS, CAMERA)


def test_another_quadrangle_is_a_wrong_lamp() -> None:
    places = ((120.0, 100.0), (300.0, 380.0), (330.0, 110.0), (500.0, 300.0), (210.0, 240.0))
    with pytest.raises((LightMissing, WrongLamp)):
        find_panel(*pair(leave_out=(0, 1, 2, 3), others=places), LIGHTS, CAMERA)


def test_glare_that_wanders_over_the_plate_does_not_matter() -> None:
    off, on = pair()
    v, u = np.mgrid[:480, :640]
    spots = [90.0 * np.exp(-0.5 * ((u - x) ** 2 + (v - 250.0) ** 2) / 35.0**2) for x in (280.0, 315.0)]
    glaring = [np.clip(image + spot, 0, 255).astype(np.uint8) for image, spot in zip((off, on), spots, strict=True)]
    np.testing.assert_allclose(find_panel(*glaring, LIGHTS, CAMERA).lights.points_px, light_pixels(), atol=0.3)


def test_another_scene_is_a_moved_camera() -> None:
    off, _ = pair()
    with pytest.raises(CameraMoved, match="do not match"):
        find_lights(off, shot(scene(77), 5))


def test_a_dark_room_without_any_texture_still_shows_its_lights() -> None:
    off, on = np.full((480, 640), 12.0, np.float32), np.full((480, 640), 12.0, np.float32)
    for place in light_pixels():
        disc(on, place, 5.0, 150.0)
    seen = find_panel(shot(off, 1), shot(on, 2), LIGHTS, CAMERA)
    np.testing.assert_allclose(seen.lights.points_px, light_pixels(), atol=0.1)


@pytest.mark.parametrize(
    ("off", "on", "words"),
    [
        (np.zeros((480, 640), np.uint16), np.zeros((480, 640), np.uint16), "8 bits"),
        (np.zeros((480, 640), np.uint8), np.zeros((240, 320), np.uint8), "sizes differ"),
        (np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.uint8), "1x1"),
        (np.zeros((480, 640, 2), np.uint8), np.zeros((480, 640, 2), np.uint8), r"not \(480, 640, 2\)"),
    ],
)
def test_what_is_no_image_pair_is_refused(off: NDArray[np.uint8], on: NDArray[np.uint8], words: str) -> None:
    with pytest.raises(InvalidRequest, match=words):
        find_lights(off, on)


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_saturated_images_show_no_lights(level: int) -> None:
    image = np.full((480, 640), level, np.uint8)
    assert len(find_lights(image, image)) == 0


def test_the_wrong_calibration_is_refused() -> None:
    other = CameraIntrinsics(width_px=320, height_px=240, fx_px=350.0, fy_px=350.0, cx_px=160.0, cy_px=120.0)
    with pytest.raises(InvalidRequest, match="640x480"):
        find_panel(*pair(), LIGHTS, other)


def test_lights_that_are_no_quadrangle_are_refused() -> None:
    blobs = find_lights(*pair())
    with pytest.raises(InvalidRequest, match=r"\(4, 3\)"):
        assign_lights(blobs, LIGHTS[:3], image_size_px=(640, 480))
    with pytest.raises(InvalidRequest, match="least"):
        assign_lights(blobs, LIGHTS, image_size_px=(640, 480), least=1)


def test_registration_finds_shift_turn_and_gain() -> None:
    first = scene(9)
    turn = cv2.getRotationMatrix2D((320.0, 240.0), 0.2, 1.0)
    turn[:, 2] += [1.4, -0.8]
    second = 0.92 * cv2.warpAffine(first, turn, (640, 480), borderMode=cv2.BORDER_REFLECT) + 6.0
    found = register(shot(first, 1).astype(np.float32), shot(np.asarray(second), 2).astype(np.float32), noise=1.5)
    corners = np.array([[30.0, 30.0, 1.0], [610.0, 30.0, 1.0], [610.0, 450.0, 1.0], [30.0, 450.0, 1.0]]).T
    np.testing.assert_allclose(found.second_from_first @ corners, turn @ corners, atol=0.2)
    smooth, ramp = (cv2.blur(image.astype(np.float32), (25, 25))[found.inside] for image in (found.warped, second))
    assert np.polyfit(ramp, smooth, 1)[0] == pytest.approx(1.0, abs=0.03)  # in the second image's gray levels


@pytest.mark.parametrize(("stress", "share"), [(False, 1.0), (True, 0.75)])
def test_drawn_pairs(stress: bool, share: float) -> None:
    right = 0
    pairs = list(drawn_pairs(12, stress=stress, seed=5))
    for item in pairs:
        found = seen_lights(item)
        hits = [len(found) and np.linalg.norm(found - p, axis=1).min() < 3.0 for p in item.lights_px[item.visible]]
        right += all(hits)
    assert right >= share * len(pairs)


@pytest.mark.parametrize("stress", [False, True])
def test_stored_pairs(stress: bool) -> None:
    pairs = list(stored_pairs(stress=stress))
    if not pairs:
        pytest.skip("the development images are not beside the repository")
    for item in pairs:
        found = seen_lights(item)
        for place in item.lights_px[item.visible]:
            assert np.linalg.norm(found - place, axis=1).min() < 1.0


def test_refusals_are_perception_errors_with_a_hint() -> None:
    for kind in (CameraMoved, LightMissing, WrongLamp):
        assert issubclass(kind, PerceptionError)
        assert kind("what", hint="do this").for_people().count("do this") == 1


def test_blue_lamps_are_as_good_as_white_ones() -> None:
    off, on = (np.repeat(image[:, :, None], 3, axis=2) for image in pair(leave_out=(0, 1, 2, 3)))
    blue = on.astype(np.float32)
    lamps = np.zeros((480, 640), np.float32)
    for place in light_pixels():
        disc(lamps, place, 5.5, 110.0)
    blue[:, :, 2] += lamps
    seen = find_panel(off, np.clip(blue, 0, 255).astype(np.uint8), LIGHTS, CAMERA)
    np.testing.assert_allclose(seen.lights.points_px, light_pixels(), atol=0.3)


def test_an_upside_down_trapezium_is_not_taken_for_an_upright_one() -> None:
    trapezium = np.array([[-0.1, 0.12, 0.0], [0.1, 0.12, 0.0], [0.2, -0.12, 0.0], [-0.2, -0.12, 0.0]])
    upside_down = np.diag([-1.0, -1.0, 1.0]) @ FRONT
    off, on = scene(3), scene(3)
    for place in project(trapezium @ upside_down.T + [0.0, 0.0, 0.62], CAMERA):
        disc(on, place, 5.5, 80.0)
    with pytest.raises((WrongLamp, LightMissing)):
        find_panel(shot(off, 1), shot(on, 2), trapezium, CAMERA)
    turned = find_panel(
        shot(off, 1),
        shot(on, 2),
        trapezium,
        CAMERA,
        prior=PanelPrior(camera_from_panel=transform(upside_down, (0.0, 0.0, 0.6))),
    )
    assert np.degrees(Rotation.from_matrix(turned.pose.rotation @ upside_down.T).magnitude()) < 2.0


def _expected(offset_m: float, turn_rad: float, *, tolerance_m: float, tolerance_rad: float) -> PanelPrior:
    true = transform(R_TRUE, T_TRUE)
    return PanelPrior(
        camera_from_panel=true,
        camera_from_expected=true * transform_rpy((offset_m, 0.0, 0.0), (0.0, 0.0, turn_rad)),
        position_tolerance_m=tolerance_m,
        angle_tolerance_rad=tolerance_rad,
    )


@pytest.mark.parametrize(("offset_m", "turn_rad"), [(0.1, 0.0), (0.0, 0.3)])
def test_a_panel_where_it_cannot_be_is_refused_and_within_the_tolerance_it_is_not(
    offset_m: float, turn_rad: float
) -> None:
    images = pair()
    narrow = _expected(offset_m, turn_rad, tolerance_m=0.05, tolerance_rad=0.15)
    with pytest.raises(NotFound, match="where the cell file expects it"):
        find_panel(*images, LIGHTS, CAMERA, prior=narrow)
    wide = _expected(offset_m, turn_rad, tolerance_m=0.08, tolerance_rad=0.2)
    found = find_panel(*images, LIGHTS, CAMERA, prior=wide)
    np.testing.assert_allclose(found.camera_from_panel.parent_from_child.translation, T_TRUE, atol=2e-3)


def test_loose_lamps_and_a_bad_lens_make_the_pose_less_certain() -> None:
    images = pair()
    exact, loose, bad = (
        find_panel(*images, LIGHTS, CAMERA, **more) for more in ({}, {"light_sigma_m": 1e-3}, {"lens_rms_px": 1.0})
    )
    for other in (loose, bad):
        assert (np.diag(other.camera_from_panel.covariance) > np.diag(exact.camera_from_panel.covariance)).all()
    usual_m = 1e-3 * CAMERA.fx_px / 1.0  # the default distance is one metre
    np.testing.assert_allclose(
        loose.covariance_px - exact.covariance_px, np.tile(usual_m**2 * np.eye(2), (4, 1, 1)), rtol=1e-9, atol=1e-9
    )
