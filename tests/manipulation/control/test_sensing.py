from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from hal.clock import Clock, Deadline, PacedClock, SimClock, WallClock
from hal.devices import JointState, Wrench
from hal.errors import DeviceTimeout, StaleReading
from hal.readings import Quality, Stamped
from manipulation.control.recorder import Recorder
from manipulation.control.sensing import (
    STALE_STEP_S,
    STALE_WAIT_S,
    ContactWrench,
    DeviceFailure,
    Devices,
    RangeReader,
    read_wait_s,
)
from tests.manipulation.rig import (
    LOAD,
    SENSOR,
    FakeArm,
    FakeForceTorque,
    FakeGripper,
    FakeProximity,
    FakeTouch,
    World,
)

PATIENCE_S = 0.3


def reader(world: World) -> RangeReader:
    return RangeReader(FakeProximity("near", world), world.clock, max_age_s=0.1, patience_s=PATIENCE_S)


def world_with_wall() -> World:
    world = World(clock=SimClock())
    world.wall_x_m = float(world.tip()[0, 3]) + 0.05
    return world


def test_a_missed_beat_is_bridged_and_silence_is_not() -> None:
    world = world_with_wall()
    sensor = reader(world)
    assert sensor.read(0.0) == pytest.approx(0.05)
    world.silent.add("near")
    assert sensor.read(0.9 * PATIENCE_S) == pytest.approx(0.05)
    with pytest.raises(DeviceTimeout, match="near"):
        sensor.read(1.1 * PATIENCE_S)


def test_a_sensor_that_never_spoke_is_not_waited_for() -> None:
    world = world_with_wall()
    world.silent.add("near")
    with pytest.raises(DeviceTimeout):
        reader(world).read(0.0)


def test_an_old_stamp_counts_as_silence() -> None:
    world = world_with_wall()
    sensor = reader(world)
    sensor.read(0.0)
    world.frozen.add("near")
    assert sensor.read(0.2) == pytest.approx(0.05)
    with pytest.raises(StaleReading):
        sensor.read(0.31)


def test_a_tick_waits_long_for_a_device_only_where_the_world_waits_too() -> None:
    picture_s, watchdog_s = 0.15, 0.1
    assert read_wait_s(PacedClock()) > picture_s
    assert read_wait_s(WallClock()) < watchdog_s


class Wall(WallClock):
    """Fake wall clock."""

    time_s = 100.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s


class LateArm(FakeArm):
    """Arm whose readings are old until a given time."""

    def __init__(self, clock: Clock, *, fresh_at_s: float, quality: Quality = Quality.VALID) -> None:
        super().__init__("arm", World())
        self.clock, self.fresh_at_s, self.quality, self.asked = clock, fresh_at_s, quality, 0

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        self.asked += 1
        now_s = self.clock.now_s()
        said = JointState(position_rad=np.zeros(6), velocity_rad_per_s=np.zeros(6))
        taken_s = now_s if now_s >= self.fresh_at_s else now_s - 0.15
        return Stamped(value=said, host_time_s=taken_s, sequence=1, quality=self.quality)


def devices_with(arm: FakeArm, clock: Clock) -> Devices:
    return Devices(
        arm=arm, gripper=FakeGripper("gripper", World()), force_torque=None, touch=None, proximities=(), clock=clock,
        max_age_s=0.1,
    )  # fmt: skip


def test_an_old_reading_of_the_arm_is_waited_out_on_a_wall() -> None:
    """Otherwise one reading 0.1 s old, on a busy machine, would latch the stop."""
    clock = Wall()
    arm = LateArm(clock, fresh_at_s=100.0 + 0.5 * STALE_WAIT_S)
    with pytest.raises(DeviceFailure, match=r"^gripper"):  # the arm has answered; the gripper's clock is another one
        devices_with(arm, clock).read()
    assert clock.time_s == pytest.approx(arm.fresh_at_s, abs=2 * STALE_STEP_S)


def test_an_arm_that_stays_old_fails_after_a_bounded_wait() -> None:
    clock = Wall()
    with pytest.raises(DeviceFailure, match=r"arm reading is 0\.150 s old"):
        devices_with(LateArm(clock, fresh_at_s=math.inf), clock).read()
    assert clock.time_s == pytest.approx(100.0 + STALE_WAIT_S, abs=2 * STALE_STEP_S)


def test_an_arm_in_lockstep_or_one_that_says_it_is_invalid_is_not_waited_for() -> None:
    lockstep, wall = SimClock(), Wall()
    for clock, quality in ((lockstep, Quality.VALID), (wall, Quality.INVALID)):
        arm = LateArm(clock, fresh_at_s=math.inf, quality=quality)
        with pytest.raises(DeviceFailure):
            devices_with(arm, clock).read()
        assert arm.asked == 1


class LostArm(FakeArm):
    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        return self.stamped(JointState(position_rad=np.full(6, np.nan), velocity_rad_per_s=np.zeros(6)))


class BrokenForceTorque(FakeForceTorque):
    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        return self.stamped(Wrench(force_n=np.zeros(3), torque_nm=np.array([0.0, np.inf, 0.0])))


@pytest.mark.parametrize(
    ("arm", "force_torque", "blamed"), [(LostArm, FakeForceTorque, "arm"), (FakeArm, BrokenForceTorque, "wrist_ft")]
)
def test_a_number_that_is_none_is_blamed_on_the_device_that_gave_it(
    arm: type[FakeArm], force_torque: type[FakeForceTorque], blamed: str
) -> None:
    world = world_with_wall()
    devices = Devices(
        arm=arm("arm", world),
        gripper=FakeGripper("gripper", world),
        force_torque=force_torque("wrist_ft", world),
        touch=FakeTouch("finger_touch", world),
        proximities=(reader(world),),
        clock=world.clock,
        max_age_s=0.1,
    )
    with pytest.raises(DeviceFailure, match=f"{blamed}: a reading is not finite"):
        devices.read()


def test_nothing_in_range_is_an_answer() -> None:
    world = world_with_wall()
    world.wall_x_m = math.inf
    assert math.isnan(reader(world).read(0.0))


@given(turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3))
@settings(max_examples=40, deadline=None)
def test_at_rest_in_any_posture_weight_and_bias_leave_no_contact(turn: list[float]) -> None:
    flange = RigidTransform.from_components([0.1, 0.2, 0.3], Rotation.from_rotvec(turn))
    sensor = flange * SENSOR
    gravity = sensor.rotation.inv().apply([0.0, 0.0, -9.80665 * LOAD.mass_kg])
    raw = np.concatenate([gravity, np.cross(LOAD.centre_of_mass_m, gravity)]) + np.asarray(LOAD.bias)
    found = ContactWrench(LOAD, SENSOR).in_flange(raw, np.ascontiguousarray(flange.as_matrix()))
    assert np.abs(found).max() < 1e-9


def test_the_recorder_sums_up_the_force_of_the_ticks_in_contact_only() -> None:
    recorder = Recorder(0.002)
    forces_n = [0.0, 10.0, 14.0, 2.0, 20.0, 20.0]
    for k, force_n in enumerate(forces_n):
        recorder.note(0.002 * k, np.zeros(6), np.zeros(6), np.zeros(3), force_n=force_n)
    assert recorder.force.impulse_n_s == pytest.approx(0.002 * (10.0 + 14.0 + 20.0 + 20.0))
    assert recorder.force.chatter_n == pytest.approx(np.sqrt((4.0**2 + 0.0) / 2))
    both = recorder.force + recorder.force
    assert (both.chatter_n, both.impulse_n_s) == pytest.approx(
        (recorder.force.chatter_n, 2 * recorder.force.impulse_n_s)
    )
