"""The angle of a handwheel must not depend on a small error of its position."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_disturbance import Disturbance
from benchmarks.vision_drawing import camera, draw_panel, looking_at
from hal.geometry import certain
from hal.panel import Handwheel, Light, Panel
from perception.vision.patch import Patch
from perception.vision.projection import CameraProjection
from perception.vision.reading import PatchReading
from perception.vision.status.handwheel import read_handwheel
from perception.vision.status.pointer import wrapped
from perception.vision.status.reader import patch_of

ANGLE_RAD = 0.7
DISTANCE_M, HEIGHT_M = 0.30, 0.026
CORNERS = ((-0.15, 0.12), (0.15, 0.12), (0.15, -0.12), (-0.15, -0.12))


def read(spokes: int, *, beside_m: tuple[float, float], seed: int = 1) -> PatchReading:
    """Read a small wheel 0.3 m away at its place by a panel pose that is slightly wrong."""
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.026, rim_m=0.004, height_m=HEIGHT_M, spokes=spokes)
    lights = tuple(Light(name=f"light_{k}", position_m=(x, y, 0.0005)) for k, (x, y) in enumerate(CORNERS))
    panel = Panel(schema=1, name="small", width_m=0.34, height_m=0.28, lights=lights, objects=(wheel,))
    pose = certain(RigidTransform.from_matrix(looking_at(distance_m=DISTANCE_M, tilt_rad=0.08)))
    view = CameraProjection(intrinsics=camera(focal_px=460.0), camera_from_panel=pose)
    image = draw_panel(
        panel, view, (480, 640), {"trim": ANGLE_RAD}, Disturbance(noise_sigma=2.5, seed=seed, blur_sigma_px=0.7)
    )
    shift_px = np.array(beside_m) * 460.0 / (DISTANCE_M - HEIGHT_M)
    return read_handwheel(patch_of(image, image, view, wheel, shift_px), wheel)


@pytest.mark.parametrize("spokes", [2, 3, 4, 5])
@pytest.mark.parametrize("towards_rad", np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False))
def test_a_wheel_one_millimetre_beside_its_place_keeps_its_angle(spokes: int, towards_rad: float) -> None:
    """A common shift of the spokes must not be read as a rotation; 0.06 rad of a small wheel make a false `done`."""
    status = read(spokes, beside_m=(0.001 * float(np.cos(towards_rad)), 0.001 * float(np.sin(towards_rad))))
    assert status.value is not None and status.uncertainty is not None
    off_rad = abs(float(wrapped(np.array(status.value - ANGLE_RAD))))
    assert off_rad < 0.012
    assert off_rad < 2.0 * status.uncertainty


def test_where_nothing_shows_nothing_is_read() -> None:
    """Without any contrast the ratio of heights is 0/0, which must not end in an error."""
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.026, rim_m=0.004, height_m=HEIGHT_M, spokes=4)
    pose = certain(RigidTransform.from_matrix(looking_at(distance_m=DISTANCE_M, tilt_rad=0.0)))
    view = CameraProjection(intrinsics=camera(focal_px=460.0), camera_from_panel=pose)
    image = np.full((480, 640), 120, np.uint8)
    status = read_handwheel(patch_of(image, image, view, wheel, np.zeros(2)), wheel)
    assert not status.answered


@pytest.mark.parametrize(("mark", "is_sure"), [(230, True), (None, False)])
def test_a_spoke_that_differs_within_the_wheels_own_grays_is_not_surely_the_marked_one(
    mark: int | None, is_sure: bool
) -> None:
    """If something makes one spoke differ and the mark of another is hidden, a wrong quarter turn must not be sure."""
    px_per_m, middle, R = 2000.0, np.full(2, 99.5), 60.0
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.030, rim_m=0.004, height_m=HEIGHT_M, spokes=4)
    picture = np.full((200, 200), 170, np.uint8)

    def point(angle_rad: float, radius: float) -> list[int]:
        place = middle + radius * R * np.array([np.sin(angle_rad), -np.cos(angle_rad)])
        return [round(16 * float(k)) for k in place]

    for k in range(4):
        gray = 70 if mark is not None or k else 125
        cv2.line(picture, point(0.0, 0.0), point(ANGLE_RAD + k * np.pi / 2, 1.0), gray, 11, cv2.LINE_AA, 4)
    cv2.circle(picture, point(0.0, 0.0), round(16 * R), 70, 12, cv2.LINE_AA, 4)
    if mark is not None:
        cv2.circle(picture, point(ANGLE_RAD, 1.0), 16 * 6, mark, -1, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.3) + noise), 0, 255).astype(np.uint8)
    patch = Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=px_per_m, image_px_per_m=px_per_m / 1.5,
        origin_px=middle, parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip
    status = read_handwheel(patch, wheel)
    assert (status.confidence >= 0.8) is is_sure
    assert not is_sure or status.value == pytest.approx(ANGLE_RAD, abs=0.03)


@pytest.mark.parametrize("spokes", [2, 3, 4])
def test_light_from_above_on_the_marked_spoke_does_not_turn_the_wheel(spokes: int) -> None:
    """The lower half of a bright round spoke is as grey as the plate; only its upper half is seen."""
    px_per_m, middle, R, angle_rad = 2000.0, np.full(2, 99.5), 60.0, -1.5
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.030, rim_m=0.004, height_m=HEIGHT_M, spokes=spokes)
    picture = np.full((200, 200), 170, np.uint8)

    def line(angle: float, gray: int, wide: int, up: float = 0.0) -> None:
        ends = [middle + [0.0, -up] + share * R * np.array([np.sin(angle), -np.cos(angle)]) for share in (0.0, 1.0)]
        a, b = ([round(16 * float(k)) for k in end] for end in ends)
        cv2.line(picture, a, b, gray, wide, cv2.LINE_AA, 4)

    for k in range(1, spokes):
        line(angle_rad + 2.0 * np.pi * k / spokes, 60, 11)
    line(angle_rad, 230, 7, up=4.0)
    cv2.circle(picture, [round(16 * float(k)) for k in middle], round(16 * R), 60, 15, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    gray = np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 1.3) + noise), 0, 255).astype(np.uint8)
    patch = Patch(
        gray=gray, colour=None, inside=np.ones(gray.shape, bool), px_per_m=px_per_m, image_px_per_m=px_per_m / 1.5,
        origin_px=middle, parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip
    assert read_handwheel(patch, wheel).value == pytest.approx(angle_rad, abs=0.015)
