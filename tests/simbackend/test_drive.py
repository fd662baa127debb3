"""Tests of the drives between set-point and motor: following, braking, the watchdog, the gripper's screw."""

from __future__ import annotations

import numpy as np
import pytest

from hal.errors import MotionRefused
from simbackend.arm_model import t3
from simbackend.drive import ArmDrive, GripperDrive
from tests.simbackend.rig import SimCell

DT_S = 0.002
REST = np.zeros(6)


def moving_drive(speed: float = 0.5) -> ArmDrive:
    """Return a drive in the middle of a motion of joint 1."""
    drive = ArmDrive(t3().capabilities, REST, DT_S)
    drive.enable(REST.tolist())
    for i in range(1, 50):
        drive.aim(np.array([speed * DT_S * i, 0, 0, 0, 0, 0]))
        drive.tick()
    return drive


def test_set_points_are_ignored_until_enabled() -> None:
    drive = ArmDrive(t3().capabilities, REST, DT_S)
    drive.aim(np.full(6, 0.1))
    drive.tick()
    np.testing.assert_array_equal(drive.setpoint, REST)


def test_stop_brakes_at_the_acceleration_limit_and_stays() -> None:
    drive = moving_drive(0.5)
    start = drive.setpoint[0]
    drive.stop()
    speeds = []
    for _ in range(200):
        drive.tick()
        speeds.append(drive.speed[0])
    limit = t3().capabilities.acceleration_rad_per_s2[0]
    assert np.all(np.diff([0.5, *speeds]) >= -limit * DT_S - 1e-12)
    assert drive.setpoint[0] - start == pytest.approx(0.5**2 / (2 * limit), rel=0.05)
    assert speeds[-1] == 0.0
    drive.aim(np.full(6, 1.0))
    drive.tick()
    assert drive.setpoint[1] == 0.0


def bunched(speed: float, ticks: int, *, every: int) -> np.ndarray:
    """Return joint 1's set-points for each tick; those of `every` ticks arrive at once, as over a link with delays."""
    return speed * DT_S * (np.arange(ticks) // every + 1) * every


def followed(goals: np.ndarray, lookahead_s: float) -> np.ndarray:
    """Return the drive's output for goals of joint 1."""
    drive = ArmDrive(t3().capabilities, REST, DT_S, lookahead_s=lookahead_s)
    drive.enable(REST.tolist())
    out = []
    for goal in goals:
        drive.aim(np.array([goal, 0, 0, 0, 0, 0]))
        drive.tick()
        out.append(drive.setpoint[0])
    return np.array(out)


def test_a_lookahead_takes_the_jerks_out_of_a_bunched_stream() -> None:
    goals = bunched(0.5, 400, every=4)
    raw, calm = (np.diff(followed(goals, lookahead_s), 2)[100:] / DT_S**2 for lookahead_s in (0.0, 0.03))
    assert np.abs(raw).max() > 200.0
    assert np.abs(calm).max() < 8.0


@pytest.mark.parametrize("lookahead_s", [0.004, 0.03, 0.2])
def test_a_lookahead_trails_a_steady_stream_by_its_own_length(lookahead_s: float) -> None:
    goals = bunched(0.5, 2000, every=1)
    late_s = (goals[-1] - followed(goals, lookahead_s)[-1]) / 0.5
    assert late_s == pytest.approx(lookahead_s, abs=DT_S)


@pytest.mark.parametrize("lookahead_s", [0.001, 0.01, 0.2])
def test_a_lookahead_comes_to_a_step_without_passing_it(lookahead_s: float) -> None:
    out = followed(np.full(1500, 0.1), lookahead_s)
    assert out.max() <= 0.1 + 1e-12
    assert out[-1] == pytest.approx(0.1, abs=1e-5)


def test_braking_begins_with_the_speed_that_the_drive_really_has() -> None:
    drive = ArmDrive(t3().capabilities, REST, DT_S, lookahead_s=0.03)
    drive.enable(REST.tolist())
    for goal in bunched(0.5, 200, every=1):
        drive.aim(np.array([goal, 0, 0, 0, 0, 0]))
        drive.tick()
    speed = drive.speed[0]
    drive.stop()
    drive.tick()
    limit = t3().capabilities.acceleration_rad_per_s2[0]
    assert speed - drive.speed[0] == pytest.approx(limit * DT_S)


def test_a_stream_that_breaks_off_in_motion_trips_the_watchdog_after_100_ms() -> None:
    drive = moving_drive()
    for _ in range(49):
        drive.tick()
    assert drive.is_enabled
    for _ in range(4):
        drive.tick()
    assert not drive.is_enabled


def test_a_stream_that_ends_at_rest_trips_nothing() -> None:
    drive = moving_drive()
    last = drive.setpoint.copy()
    for _ in range(3):
        drive.aim(last)
        drive.tick()
    for _ in range(500):
        drive.tick()
    assert drive.is_enabled


def test_the_gripper_stops_at_the_mean_pad_force_and_locks() -> None:
    gripper = GripperDrive(dt_s=DT_S)
    gripper.aim(0.0, 20.0, 0.05)
    for _ in range(50):
        gripper.tick((0.0, 0.0))
    assert gripper.is_moving
    gripper.tick((39.0, 0.0))  # if one finger alone pushes, half the force acts on the screw
    assert gripper.is_moving
    gripper.tick((25.0, 16.0))
    locked_m = gripper.width_m
    gripper.tick((0.0, 0.0))
    assert (gripper.is_holding, gripper.is_moving, gripper.width_m) == (True, False, locked_m)


def test_the_gripper_reaches_its_width_and_opens_against_any_force() -> None:
    gripper = GripperDrive(dt_s=DT_S)
    gripper.aim(0.07, 5.0, 0.1)
    for _ in range(300):
        gripper.tick((50.0, 50.0))
    assert (gripper.width_m, gripper.is_moving, gripper.is_holding) == (0.07, False, False)


def test_the_arm_holds_its_place_to_a_hundredth_of_a_milliradian(bench: SimCell) -> None:
    arm = bench.connect("arm")
    arm.enable(deadline=bench.deadline())
    start = arm.read_state(deadline=bench.deadline()).value.position_rad
    arm.command_position(start, deadline=bench.deadline())
    bench.clock.sleep(2.0)
    sag = arm.read_state(deadline=bench.deadline()).value.position_rad - start
    assert np.abs(sag).max() < 1e-5


def test_without_set_points_in_motion_the_arm_asks_for_enable(bench: SimCell) -> None:
    arm = bench.connect("arm")
    arm.enable(deadline=bench.deadline())
    q = arm.read_state(deadline=bench.deadline()).value.position_rad
    for i in range(20):
        arm.command_position(q - 4e-4 * i * np.eye(6)[0], deadline=bench.deadline())
        bench.clock.sleep(0.002)
    bench.clock.sleep(0.12)
    assert not arm.read_state(deadline=bench.deadline()).value.is_enabled
    with pytest.raises(MotionRefused):
        arm.command_position(q, deadline=bench.deadline())
    arm.enable(deadline=bench.deadline())
    here = arm.read_state(deadline=bench.deadline()).value.position_rad
    arm.command_position(here, deadline=bench.deadline())
    bench.clock.sleep(0.05)
    np.testing.assert_allclose(arm.read_state(deadline=bench.deadline()).value.position_rad, here, atol=1e-4)


def test_a_leap_is_clipped_to_the_speed_limit_and_told(bench: SimCell) -> None:
    arm = bench.connect("arm")
    arm.enable(deadline=bench.deadline())
    q = arm.read_state(deadline=bench.deadline()).value.position_rad
    sent = arm.command_position(q - 0.5, deadline=bench.deadline())
    fastest = np.array(arm.capabilities().velocity_rad_per_s) / bench.cell.file.cell.control_rate_hz
    assert np.all(np.abs(sent - q) <= 2.0 * fastest + 1e-5)
    arm.stop(deadline=bench.deadline())
    bench.clock.sleep(0.5)
    assert not arm.read_state(deadline=bench.deadline()).value.is_moving
