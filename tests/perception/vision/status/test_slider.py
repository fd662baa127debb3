"""Sliders whose cap leans over its foot: a camera before the track's middle sees the inner side of a cap at its end."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.vision_drawing import Disturbance, camera, draw_panel, looking_at
from hal.geometry import certain
from hal.panel import Light, Panel, Scale, Slider
from perception.vision.status.slider import read_slider
from perception.vision.taught import patch_of
from perception.vision.view import CameraView

TRAVEL_M = 0.100
CORNERS = ((-0.15, 0.12), (0.15, 0.12), (0.15, -0.12), (-0.15, -0.12))
SCALE = Scale(minimum=0.0, maximum=100.0, unit="%", at_min=-TRAVEL_M / 2, at_max=TRAVEL_M / 2)


@pytest.mark.parametrize("angle_rad", [0.0, np.pi / 2])
@pytest.mark.parametrize("shown", [8.0, 28.0, 38.0, 50.0, 62.0, 72.0, 92.0])
def test_a_close_up_reads_a_cap_beside_the_middle_of_its_track(shown: float, angle_rad: float) -> None:
    """It was read up to 1.1 mm nearer to the middle, and 27.7 was called 28.7 and done for 30 +- 2."""
    slider = Slider(name="speed", position_m=(0.0, 0.0), angle_rad=angle_rad, travel_m=TRAVEL_M, scale=SCALE)
    lights = tuple(Light(name=f"light_{k}", position_m=(x, y, 0.0005)) for k, (x, y) in enumerate(CORNERS))
    panel = Panel(schema=1, name="small", width_m=0.34, height_m=0.28, lights=lights, objects=(slider,))
    pose = certain(RigidTransform.from_matrix(looking_at(distance_m=0.30)))
    view = CameraView(intrinsics=camera(focal_px=460.0), camera_from_panel=pose)
    image = draw_panel(
        panel, view, (480, 640), {"speed": shown}, Disturbance(noise_sigma=2.5, seed=1, blur_sigma_px=0.7)
    )
    status = read_slider(patch_of(image, image, view, slider, np.zeros(2)), slider)
    assert status.value == pytest.approx(shown, abs=0.55)
