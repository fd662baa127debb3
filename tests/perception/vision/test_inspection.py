"""Tests of the taught panel from end to end: readings of drawn scenes with known truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.vision_disturbance import Disturbance
from benchmarks.vision_drawing import Shown
from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose
from perception.vision.annotate import draw_annotated
from perception.vision.inspection import inspect
from perception.vision.projection import CameraProjection
from perception.vision.reading import ObjectReading
from tests.perception.vision.bench_panel import SHOWN, panel, scene

VIEWS = [(0.0, 0.0, (1280, 960)), (8.0, 30.0, (1280, 960)), (15.0, 200.0, (640, 480)), (20.0, 100.0, (1280, 960))]


def check(reading: ObjectReading, shown: Shown) -> None:
    assert reading.answered, (reading.name, reading.reason)
    if reading.text is not None:
        assert reading.text == shown, reading.name
    elif reading.state is not None:
        assert reading.state == shown, reading.name
    else:
        assert reading.value == pytest.approx(shown, abs=0.02 * span(reading.name)), reading.name


def span(name: str) -> float:
    panel_object = panel().object(name)
    scale = getattr(panel_object, "scale", None)
    return 2 * np.pi / 3.6 if scale is None else scale.maximum - scale.minimum


@pytest.mark.parametrize(("tilt_deg", "azimuth_deg", "size"), VIEWS)
def test_every_kind_is_read_from_every_side(tilt_deg: float, azimuth_deg: float, size: tuple[int, int]) -> None:
    image, intrinsics, pose = scene(tilt_deg=tilt_deg, azimuth_deg=azimuth_deg, size=size)
    readings = inspect(image, intrinsics, pose, panel())
    assert [r.name for r in readings] == [panel_object.name for panel_object in panel().objects]
    for reading in readings:
        assert reading.present, (reading.name, reading.reason)
        if reading.kind in ("button", "mushroom") and not reading.answered:
            assert "alike" in (reading.reason or "")  # may be refused, as a 5 mm stroke is hard to see from the front
            continue
        check(reading, SHOWN[reading.name])


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("pressure", 0.4),
        ("pressure", 9.7),
        ("volts", 4.8),
        ("flow", "108.6"),
        ("level", "5"),
        ("ready", "off"),
        ("start", "pressed"),
        ("power", "on"),
        ("mode", "off"),
        ("mode", "low"),
        ("speed", 96.0),
        ("inlet", "closed"),
        ("drain", -2.4),
        ("emergency", "pressed"),
    ],
)
def test_other_states_are_told_apart(name: str, shown: Shown) -> None:
    image, intrinsics, pose = scene(tilt_deg=18.0, azimuth_deg=60.0, shown={name: shown})
    (reading,) = inspect(image, intrinsics, pose, panel(), names=[name])
    check(reading, shown)


def test_centres_come_back_within_half_a_millimetre() -> None:
    image, intrinsics, pose = scene()
    for reading in inspect(image, intrinsics, pose, panel(), names=["pressure", "flow", "drain", "volts"]):
        assert reading.centre_m is not None and reading.centre_covariance_m2 is not None
        assert np.linalg.norm(reading.centre_m - np.array(panel().object(reading.name).point_m)) < 5e-4
        assert np.linalg.eigvalsh(reading.centre_covariance_m2).min() > 0


def test_an_object_that_is_not_there_is_not_read() -> None:
    image, intrinsics, pose = scene()
    image = image.copy()
    moved = inspect(image, intrinsics, pose, panel(), names=["speed"])[0]
    u, v = np.round(moved.centre_px).astype(int)
    image[v - 60 : v + 60, u - 130 : u + 130] = 150
    (reading,) = inspect(image, intrinsics, pose, panel(), names=["speed"])
    assert not reading.present and reading.value is None and reading.reason


def test_another_panel_is_refused_as_a_whole() -> None:
    image, intrinsics, pose = scene()
    upside_down = np.ascontiguousarray(image[::-1, ::-1])
    with pytest.raises(NotFound):
        inspect(
            np.full_like(image, 128) + (np.indices(image.shape).sum(axis=0) % 7).astype(np.uint8),
            intrinsics,
            pose,
            panel(),
        )
    try:
        readings = inspect(upside_down, intrinsics, pose, panel())
    except NotFound:
        return
    sure = [r for r in readings if r.answered and r.value is not None and r.kind in ("gauge", "panel_meter")]
    assert not sure


@pytest.mark.parametrize(
    ("image", "error"),
    [
        (np.zeros((960, 1280), np.uint8), NotObservable),
        (np.full((960, 1280), 255, np.uint8), NotObservable),
        (np.zeros((1, 1), np.uint8), InvalidRequest),
        (np.zeros((960, 1280), np.uint16), InvalidRequest),
        (np.zeros((480, 640), np.uint8) + np.arange(640, dtype=np.uint8), InvalidRequest),
    ],
)
def test_bad_images_are_refused_by_type(image: np.ndarray, error: type[Exception]) -> None:
    _, intrinsics, pose = scene(distance_m=0.7)
    with pytest.raises(error):
        inspect(image, intrinsics, pose, panel())


def test_a_covered_face_is_refused_and_not_guessed() -> None:
    image, intrinsics, pose = scene()
    (gauge,) = inspect(image, intrinsics, pose, panel(), names=["pressure"])
    u, v = gauge.centre_px
    glare = Disturbance(glare=((float(u), float(v), 160.0),))
    drowned, _, _ = scene(disturbance=glare)
    (reading,) = inspect(drowned, intrinsics, pose, panel(), names=["pressure"])
    assert reading.value is None and reading.reason


def test_the_annotated_picture_is_rgb_and_leaves_the_image_alone() -> None:
    image, intrinsics, pose = scene()
    before = image.copy()
    picture = draw_annotated(image, inspect(image, intrinsics, pose, panel()))
    assert picture.shape == (*image.shape, 3) and picture.dtype == np.uint8
    assert (picture != np.repeat(image[:, :, None], 3, axis=2)).any()
    assert (image == before).all()


def behind_a_cable(offset_m: float) -> tuple[np.ndarray, CameraIntrinsics, UncertainPose]:
    """Draw the panel with a dark cable in front of the display `flow`, at a distance to the right of its centre."""
    image, intrinsics, pose = scene(tilt_deg=3.0, distance_m=0.66, pose_error=0.0)
    x, y = panel().object("flow").position_m
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    ends = view.project([[x + offset_m, y + 0.08, 0.0], [x + offset_m, y - 0.08, 0.0]])
    first, last = (tuple(int(value) for value in end) for end in ends)
    return np.asarray(cv2.line(image.copy(), first, last, 35, 9)), intrinsics, pose


def test_who_asks_for_less_gets_the_likeliest_number_of_a_hidden_display() -> None:
    look = behind_a_cable(0.012)
    (refusal,) = inspect(*look, panel(), names=["flow"])
    assert not refusal.answered and refusal.text is None and refusal.value is None
    (guess,) = inspect(*look, panel(), names=["flow"], least_confidence=0.0)
    assert guess.answered and guess.text == refusal.possible[0].text == SHOWN["flow"]
    assert guess.possible == refusal.possible and 0.0 < guess.confidence < 0.5
    (barely,) = inspect(*look, panel(), names=["flow"], least_confidence=guess.confidence + 0.005)
    assert not barely.answered


def test_who_asks_for_more_gets_only_the_surest() -> None:
    image, intrinsics, pose = scene()
    plain = inspect(image, intrinsics, pose, panel())
    strict = inspect(image, intrinsics, pose, panel(), least_confidence=0.96)
    assert {r.name for r in strict if r.answered} == {r.name for r in plain if r.answered and r.confidence >= 0.96}
    assert all(r.reason for r in strict if not r.answered) and any(not r.answered for r in strict)


def test_a_jump_is_a_guess_and_no_answer() -> None:
    look = behind_a_cable(-0.012)  # read with a confidence of less than 0.9
    (seen,) = inspect(*look, panel(), names=["flow"])
    far = replace(seen, value=getattr(panel().object("flow"), "maximum", None))
    (refusal,) = inspect(*look, panel(), names=["flow"], previous={"flow": far})
    assert seen.answered and not refusal.answered and "far from the last reading" in (refusal.reason or "")
    (guess,) = inspect(*look, panel(), names=["flow"], previous={"flow": far}, least_confidence=0.0)
    assert guess.text == seen.text and guess.confidence < 0.5
