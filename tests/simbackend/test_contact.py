"""Tests of the arm at the panel: weight, touch, proximity, a pressed button and its lamp, read from the devices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from eaik.IK_DH import DhRobot
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.simulated import ObjectTruth
from simbackend.arm_model import base_from_flange
from simbackend.client import true_mount
from simbackend.draws import Draws
from tests.simbackend.rig import SimCell, sim_cell

FACING = RigidTransform.from_matrix(np.diag([1.0, -1.0, -1.0, 1.0]))
TICK_S = 0.002


@dataclass(eq=False)
class Finger:
    """Moves closed fingers by the true panel pose, because these tests are about sensors."""

    cell: SimCell

    def __post_init__(self) -> None:
        self.arm, self.gripper = self.cell.connect("arm"), self.cell.connect("gripper")
        links = self.arm.capabilities().links
        self.eaik = DhRobot(*(np.array([getattr(link, key) for link in links]) for key in ("alpha_rad", "a_m", "d_m")))
        self.grip_mount = true_mount(self.cell.cell, Draws(self.cell.cell.file.cell.seed), "gripper")
        self.panel = RigidTransform.from_matrix(self.arm.truth().base_from_panel_matrix)
        self.arm.enable(deadline=self.cell.deadline())
        self.gripper.command(width_m=0.0, force_n=20.0, speed_m_per_s=0.1, deadline=self.cell.deadline())
        self.cell.clock.sleep(1.0)

    def joints(self) -> Array:
        return np.asarray(self.arm.read_state(deadline=self.cell.deadline()).value.position_rad)

    def solve(self, point_m: Array) -> Array:
        flange = self.panel * RigidTransform.from_translation(point_m) * FACING * self.grip_mount.inv()
        found = self.eaik.IK(np.asarray(flange.as_matrix()))
        here, caps = self.joints(), self.arm.capabilities()
        fits = [q for q in found.Q if np.all((q > caps.lower_rad) & (q < caps.upper_rad))]
        return np.asarray(min(fits, key=lambda q: np.abs(q - here).max()))

    def go(self, point_m: Array, seconds: float) -> None:
        """Move on a straight line in joint space, which is nearly straight in space over a few centimetres."""
        start, goal = self.joints(), self.solve(point_m)
        steps = round(seconds / TICK_S)
        for i in range(1, steps + 1):
            s = i / steps
            self.arm.command_position(start + (goal - start) * s * s * (3 - 2 * s), deadline=self.cell.deadline())
            self.cell.clock.sleep(TICK_S)

    def shown(self, name: str) -> ObjectTruth:
        return next(panel_object for panel_object in self.arm.truth().objects if panel_object.name == name)


@pytest.fixture(scope="module")
def finger() -> Iterator[Finger]:
    with sim_cell(seed=3) as cell:
        yield Finger(cell)


def place(finger: Finger, name: str, height_m: float) -> Array:
    return np.array([*finger.cell.cell.panel.object(name).position_m, height_m])


def test_at_rest_the_sensor_carries_the_weight_of_the_tool_and_its_bias(finger: Finger) -> None:
    cell = finger.cell
    record = cell.cell.calibration_of("wrist_ft")
    assert record.load is not None
    draws = Draws(cell.cell.file.cell.seed)
    load = draws.load("wrist_ft", record.load.load())
    cell.clock.sleep(0.3)
    force = cell.connect("wrist_ft", force_sigma_n=0.0, torque_sigma_nm=0.0, force_drift_n=0.0, torque_drift_nm=0.0)
    wrench = force.read_wrench(deadline=cell.deadline()).value
    base_from_flange_ = base_from_flange(finger.arm.capabilities().links, finger.joints())
    base_from_sensor = base_from_flange_ * true_mount(cell.cell, draws, "wrist_ft")
    weight_n = base_from_sensor.rotation.inv().apply([0.0, 0.0, -9.81 * load.mass_kg])
    np.testing.assert_allclose(wrench.force_n - load.bias[:3], weight_n, atol=0.03)
    # The recorded centre of mass explains the torque to a lever arm of a few millimetres.
    torque_nm = np.cross(load.centre_of_mass_m, weight_n)
    np.testing.assert_allclose(wrench.torque_nm - load.bias[3:], torque_nm, atol=0.05)


def test_proximity_is_the_distance_to_the_plate(finger: Finger) -> None:
    cell = finger.cell
    finger.go(np.array([0.02, 0.055, 0.060]), 2.0)  # in front of bare plate
    near = cell.connect("proximity_left", sigma_m=0.0, resolution_m=1e-6)
    measured_m = near.read_distance_m(deadline=cell.deadline()).value
    pose = base_from_flange(finger.arm.capabilities().links, finger.joints())
    panel_from_sensor = finger.panel.inv() * pose * true_mount(cell.cell, Draws(3), "proximity_left")
    height_m, slope = panel_from_sensor.translation[2], -panel_from_sensor.rotation.apply([0.0, 0.0, 1.0])[2]
    assert measured_m == pytest.approx(height_m / slope, abs=1e-4)


def test_a_pressed_button_is_felt_counted_and_lights_its_lamp(finger: Finger) -> None:
    cell = finger.cell
    button = cell.cell.panel.object("start")
    touch, force = cell.connect("finger_touch"), cell.connect("wrist_ft")
    finger.go(place(finger, "start", button.height_m + 0.03), 2.0)
    lamp, pressed = finger.shown("run_lamp").state, finger.shown("start")
    free = force.read_wrench(deadline=cell.deadline()).value.force_n[2]
    assert touch.read_contacts(deadline=cell.deadline()).value == (False, False)
    finger.go(place(finger, "start", button.height_m - 0.95 * button.travel_m), 1.0)
    cell.clock.sleep(0.05)
    assert any(touch.read_contacts(deadline=cell.deadline()).value)
    push_n = free - force.read_wrench(deadline=cell.deadline()).value.force_n[2]
    assert 4.0 < push_n < 14.0  # force of the spring in the file, with tolerance and the pads' contribution
    assert finger.shown("start").state == "pressed"
    finger.go(place(finger, "start", button.height_m + 0.03), 1.0)
    after = finger.shown("start")
    assert (after.state, after.value) == ("released", (pressed.value or 0.0) + 1.0)
    after_lamp = finger.shown("run_lamp").state
    assert after_lamp != lamp
    assert touch.read_contacts(deadline=cell.deadline()).value == (False, False)
    assert finger.arm.truth().peak_force_n >= push_n - 1.0
    for seconds_ago, lit in ((0.0, after_lamp), (5.0, lamp)):
        then = finger.arm.truth(finger.arm.truth().sim_time_s - seconds_ago).initial
        assert next(panel_object for panel_object in then if panel_object.name == "run_lamp").state == lit


def test_the_lamp_of_the_button_shows_in_the_picture(finger: Finger) -> None:
    cell = finger.cell
    camera = cell.connect("wrist_camera")
    finger.go(np.array([0.12, -0.03, 0.30]), 2.0)
    dark = camera.read_image(deadline=cell.deadline()).value.pixels.astype(int)
    lit = finger.shown("run_lamp").state == "on"
    button = cell.cell.panel.object("start")
    for height_m, seconds in ((0.03, 2.0), (-0.95 * button.travel_m, 0.8), (0.03, 0.8)):
        finger.go(place(finger, "start", button.height_m + height_m), seconds)
    finger.go(np.array([0.12, -0.03, 0.30]), 2.0)
    bright = camera.read_image(deadline=cell.deadline()).value.pixels.astype(int)
    change = (dark - bright) if lit else (bright - dark)
    assert np.count_nonzero(change > 60) > 60
    assert np.count_nonzero(change < -60) < np.count_nonzero(change > 60) / 2
