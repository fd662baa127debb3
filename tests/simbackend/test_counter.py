"""Simulated counters: how their drums stand, and that the camera's image of them is read as the simulator drew them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from hal.config import load_cell
from hal.geometry import UncertainPose
from hal.panel import Panel, Shown
from hal.simulated import ObjectTruth
from hal.strict import parse_toml
from perception.vision import ObjectReading, inspect
from simbackend.arm_model import base_from_flange, t3
from simbackend.bodies.counter import drum_places
from simbackend.client import true_mount
from simbackend.draws import Draws
from tests.simbackend.rig import BENCH, SimCell

SEED = 13
HEAD = """
schema = 1
name = "counters"
width_m = 0.62
height_m = 0.46
lights = [
  { name = "a", position_m = [-0.28, 0.20, 0.0] }, { name = "b", position_m = [0.28, 0.20, 0.0] },
  { name = "c", position_m = [0.28, -0.20, 0.0] }, { name = "d", position_m = [-0.28, -0.20, 0.0] },
]
"""
COUNTER = """
[[objects]]
kind = "counter"
name = "counter_{k}"
position_m = [{x}, {y}]
width_m = 0.09
height_m = 0.028
ink = "{ink}"
decimals = {decimals}
"""


@pytest.mark.parametrize(
    ("steps", "places"),
    [(42.0, [0, 0, 4, 2]), (42.5, [0, 0, 4, 2.5]), (49.5, [0, 0, 4.5, 9.5]), (1999.25, [1.25, 9.25, 9.25, 9.25])],
)
def test_a_drum_turns_with_the_one_that_passes_nine(steps: float, places: list[float]) -> None:
    assert drum_places(steps, 4) == places


@pytest.fixture(scope="module")
def seen() -> list[tuple[ObjectReading, ObjectTruth, bool]]:
    """Return what one image from the park pose says of nine counters, what is true, and whether that is right."""
    places = [(x, y) for y in (0.12, 0.0, -0.12) for x in (-0.14, 0.0, 0.14)]
    rows = [
        COUNTER.format(k=k, x=x, y=y, ink="black" if k % 3 == 2 else "white", decimals=k % 2)
        for k, (x, y) in enumerate(places)
    ]
    panel = parse_toml(HEAD + "".join(rows), Panel, source="counters")
    simulated = SimCell(cell=load_cell(BENCH, seed=SEED).model_copy(update={"panel": panel}))
    try:
        arm, camera = simulated.connect("arm"), simulated.connect("wrist_camera")
        image = camera.read_image(deadline=simulated.deadline()).value
        joints_rad = np.asarray(arm.read_state(deadline=simulated.deadline()).value.position_rad)
        truth = arm.truth()
    finally:
        simulated.shared.close()
    mount = true_mount(simulated.cell, Draws(SEED), "wrist_camera")
    base_from_camera = base_from_flange(t3().capabilities.links, joints_rad) * mount
    camera_from_panel = base_from_camera.inv() * RigidTransform.from_matrix(truth.base_from_panel_matrix)
    lens = simulated.cell.calibration_of("wrist_camera").intrinsics
    assert lens is not None
    pose = UncertainPose(parent_from_child=camera_from_panel, covariance=1e-7 * np.eye(6))
    readings = inspect(image.pixels, lens.intrinsics(), pose, panel)
    true = {each.name: each for each in truth.objects}
    return [
        (reading, true[reading.name], panel.object(reading.name).is_right(said(reading), said(true[reading.name])))
        for reading in readings
    ]


def said(shown: ObjectReading | ObjectTruth) -> Shown:
    return Shown(value=shown.value, state=shown.state, text=shown.text)


def test_the_cameras_image_of_nine_counters_is_read(seen: list[tuple[ObjectReading, ObjectTruth, bool]]) -> None:
    assert len(seen) == 9
    assert all(is_right for reading, _, is_right in seen if reading.answered)
    assert sum(reading.answered for reading, _, _ in seen) >= 8


def test_a_drum_between_two_digits_is_read_between_them(seen: list[tuple[ObjectReading, ObjectTruth, bool]]) -> None:
    turning = [(reading, true) for reading, true, _ in seen if reading.answered and str(true.value) != true.text]
    shares = [(true.value or 0.0) * 10.0 ** len((true.text or "").partition(".")[2]) % 1.0 for _, true in turning]
    between = [reading for (reading, _), share in zip(turning, shares, strict=True) if 0.2 < share < 0.8]
    assert between and all(reading.value != float(reading.text or "nan") for reading in between)
