"""Wheels that are seen a little beside their place: their angle must not turn with that."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_drawing import Disturbance, camera, draw_panel, looking_at
from hal.geometry import certain
from hal.panel import Handwheel, Light, Panel
from perception.vision.reading import Status
from perception.vision.status.handwheel import read_handwheel
from perception.vision.status.pointer import wrapped
from perception.vision.taught import patch_of
from perception.vision.view import CameraView

ANGLE_RAD = 0.7
DISTANCE_M, HEIGHT_M = 0.30, 0.026
CORNERS = ((-0.15, 0.12), (0.15, 0.12), (0.15, -0.12), (-0.15, -0.12))


def read(spokes: int, *, beside_m: tuple[float, float], seed: int = 1) -> Status:
    """A small wheel 0.3 m away, read where it would be if the panel's pose were right."""
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.026, rim_m=0.004, height_m=HEIGHT_M, spokes=spokes)
    lights = tuple(Light(name=f"light_{k}", position_m=(x, y, 0.0005)) for k, (x, y) in enumerate(CORNERS))
    panel = Panel(schema=1, name="small", width_m=0.34, height_m=0.28, lights=lights, objects=(wheel,))
    pose = certain(RigidTransform.from_matrix(looking_at(distance_m=DISTANCE_M, tilt_rad=0.08)))
    view = CameraView(intrinsics=camera(focal_px=460.0), camera_from_panel=pose)
    image = draw_panel(
        panel, view, (480, 640), {"trim": ANGLE_RAD}, Disturbance(noise_sigma=2.5, seed=seed, blur_sigma_px=0.7)
    )
    shift_px = np.array(beside_m) * 460.0 / (DISTANCE_M - HEIGHT_M)
    return read_handwheel(patch_of(image, image, view, wheel, shift_px), wheel)


@pytest.mark.parametrize("spokes", [3, 4, 5])
@pytest.mark.parametrize("towards_rad", np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False))
def test_a_wheel_one_millimetre_beside_its_place_keeps_its_angle(spokes: int, towards_rad: float) -> None:
    """The share of the spokes that moved alike gave it: 0.06 rad of a small wheel in a mission, and a false `done`."""
    status = read(spokes, beside_m=(0.001 * float(np.cos(towards_rad)), 0.001 * float(np.sin(towards_rad))))
    assert status.value is not None and status.uncertainty is not None
    off_rad = abs(float(wrapped(np.array(status.value - ANGLE_RAD))))
    assert off_rad < 0.012
    assert off_rad < 2.0 * status.uncertainty


def test_where_nothing_shows_nothing_is_read() -> None:
    """Heights of nothing over nothing were NaN, and the reader ended with an error."""
    wheel = Handwheel(name="trim", position_m=(0.0, 0.0), radius_m=0.026, rim_m=0.004, height_m=HEIGHT_M, spokes=4)
    pose = certain(RigidTransform.from_matrix(looking_at(distance_m=DISTANCE_M, tilt_rad=0.0)))
    view = CameraView(intrinsics=camera(focal_px=460.0), camera_from_panel=pose)
    image = np.full((480, 640), 120, np.uint8)
    status = read_handwheel(patch_of(image, image, view, wheel, np.zeros(2)), wheel)
    assert not status.answered
