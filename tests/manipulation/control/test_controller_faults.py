"""What the controller does when the arm or a device fails, and when it is stopped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.errors import DeviceFault, MotionRefused, Stopped
from hal.motion import Guard, Hold, MotionOutcome, Quantity
from tests.manipulation.control.test_controller import forwards
from tests.manipulation.rig import HOME, Rig


def test_an_arm_that_does_not_follow_is_a_fault(rig: Rig) -> None:
    stuck = HOME.copy()

    def jam() -> None:
        rig.world.target = stuck

    rig.world.before_step = jam
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.FAULT and report.tripped == "tracking"
    assert report.device == "arm" and "does not follow" in report.cause


def frozen_in_motion(rig: Rig) -> None:
    """Let the arm move while it repeats one reading with new stamps, until the controller detects it."""
    rig.world.before_step = lambda: rig.world.repeating.add("arm") if rig.world.ticks == 300 else None
    report = rig.controller.execute(forwards(0.1))
    assert (report.tripped, report.device) == ("tracking", "arm")
    rig.world.before_step = lambda: None
    rig.world.commands.clear()


def test_an_arm_that_failed_is_left_to_its_own_brake(rig: Rig) -> None:
    frozen_in_motion(rig)
    assert not rig.world.enabled


def test_an_arm_whose_reading_is_still_wrong_is_not_sent_there_after_a_reset(rig: Rig) -> None:
    """Otherwise the arm would jump back by 22 mm, because the next motion begins at the wrong reading."""
    frozen_in_motion(rig)
    stood = rig.world.q.copy()
    rig.world.stride_rad = 0.006
    for _ in range(2):
        report = rig.controller.execute(Hold(name="settle", duration_s=0.1))
        assert (report.outcome, report.device) == (MotionOutcome.FAULT, "arm")
        assert "does not follow" in report.cause and report.cause.endswith("nothing moved")
    assert np.array_equal(rig.world.q, stood) and not rig.world.enabled


def test_an_arm_that_is_well_again_goes_on_from_where_it_is(rig: Rig) -> None:
    frozen_in_motion(rig)
    stood = rig.world.q.copy()
    rig.world.repeating.clear()
    rig.world.stride_rad = 0.006
    assert rig.controller.execute(Hold(name="settle", duration_s=0.1)).outcome is MotionOutcome.COMPLETED
    assert np.abs(np.array(rig.world.commands) - stood).max() < 1e-9
    assert rig.controller.execute(forwards(0.02, start=rig.world.q)).outcome is MotionOutcome.COMPLETED


@pytest.mark.parametrize("act", ["motion", "tare"])
def test_an_arm_that_says_it_is_not_where_it_was_held_is_not_sent_there(rig: Rig, act: str) -> None:
    """A bias of 20 mrad on all joints that appears between two motions would make each motion begin with a jump."""
    assert rig.controller.execute(Hold(name="still", duration_s=0.02)).outcome is MotionOutcome.COMPLETED
    rig.world.commands.clear()
    rig.world.bias_rad = 0.02
    if act == "motion":
        report = rig.controller.execute(Hold(name="settle", duration_s=0.1))
        assert (report.outcome, report.device) == (MotionOutcome.FAULT, "arm")
        assert "away from its last set-point; nothing moved" in report.cause
    else:
        with pytest.raises(DeviceFault, match="does not follow"):
            rig.controller.tare()
    assert rig.world.commands == [] and np.array_equal(rig.world.q, HOME)
    assert not rig.world.enabled


@pytest.mark.parametrize("device", ["arm", "gripper", "wrist_ft", "finger_touch", "proximity_left"])
@pytest.mark.parametrize("how", ["silent", "frozen"])
def test_a_device_that_fails_in_motion_stops_the_arm_and_is_named(rig: Rig, device: str, how: str) -> None:
    def fail() -> None:
        if rig.world.ticks == 300:
            getattr(rig.world, how).add(device)

    rig.world.before_step = fail
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.FAULT
    assert report.device == device
    assert report.cause.count(device) == 1, "named, and once"
    assert rig.controller.state().faults == (report.cause,)
    after = rig.world.ticks
    assert after < 300 + 120
    assert np.abs(rig.world.velocity).max() < 1e-3


@pytest.mark.parametrize("device", ["arm", "gripper", "wrist_ft", "finger_touch", "proximity_left"])
def test_a_defect_of_a_driver_stops_the_arm_as_gently_as_a_failing_device(rig: Rig, device: str) -> None:
    def fail() -> None:
        if rig.world.ticks == 300:
            rig.world.defective.add(device)

    rig.world.before_step = fail
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.FAULT
    assert report.device == device and "ZeroDivisionError" in report.cause
    assert rig.world.ticks < 300 + 120
    assert np.abs(rig.world.velocity).max() < 1e-3


@pytest.mark.parametrize("device", ["gripper", "wrist_ft", "finger_touch", "proximity_left"])
@pytest.mark.parametrize("how", ["silent", "frozen"])
def test_a_retreat_needs_the_arm_only_and_names_the_sensor_that_it_goes_without(
    rig: Rig, device: str, how: str
) -> None:
    rig.controller.execute(Hold(name="first", duration_s=0.02))
    getattr(rig.world, how).add(device)
    rig.controller.execute(Hold(name="age", duration_s=0.2))
    begun_m = rig.world.tip()[0, 3]
    report = rig.controller.execute(replace(forwards(-0.05), is_retreat=True))
    assert report.outcome is MotionOutcome.COMPLETED
    assert device in report.cause
    assert rig.world.tip()[0, 3] == pytest.approx(begun_m - 0.05, abs=1e-3)
    assert device in rig.controller.state().faults[0], "the fault stays named"


def test_a_retreat_ends_when_the_arm_itself_fails(rig: Rig) -> None:
    rig.controller.execute(Hold(name="first", duration_s=0.02))
    rig.world.silent.add("arm")
    report = rig.controller.execute(replace(forwards(-0.05), is_retreat=True))
    assert report.outcome is MotionOutcome.FAULT and report.device == "arm"


def test_a_device_that_is_dead_before_the_start_moves_nothing(rig: Rig) -> None:
    rig.world.silent.add("wrist_ft")
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.FAULT and "wrist_ft" in report.cause
    assert rig.world.commands == []


def test_the_latch_stops_a_motion_and_refuses_the_next(rig: Rig) -> None:
    def press() -> None:
        rig.latched[0] = rig.world.ticks >= 200

    rig.world.before_step = press
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.STOPPED
    assert not rig.world.enabled
    assert np.abs(rig.world.velocity).max() < 1e-3
    with pytest.raises(Stopped):
        rig.controller.execute(forwards(0.1))


@pytest.mark.parametrize("dead", ["arm", "gripper", "wrist_ft", "finger_touch", "proximity_left"])
def test_a_stop_between_motions_switches_the_drives_off_though_a_device_is_dead(rig: Rig, dead: str) -> None:
    assert rig.controller.execute(Hold(name="still", duration_s=0.02)).outcome is MotionOutcome.COMPLETED
    assert rig.world.enabled
    rig.world.silent.add(dead)
    rig.world.clock.sleep(1.0)  # longer than all time limits
    rig.latched[0] = True
    rig.controller._hold()  # as the control thread does in each tick on a wall clock
    assert not rig.world.enabled


def test_after_a_stop_the_first_set_point_is_the_measured_position(rig: Rig) -> None:
    rig.world.before_step = lambda: rig.latched.__setitem__(0, rig.world.ticks == 200)
    rig.controller.execute(forwards(0.1))
    rig.latched[0] = False
    rig.world.before_step = lambda: None
    moved = rig.world.q + 0.1  # the arm was moved by hand meanwhile
    rig.world.q = rig.world.target = moved
    rig.world.commands.clear()
    rig.controller.execute(Hold(name="still", duration_s=0.02))
    assert np.abs(rig.world.commands[0] - moved).max() < 1e-9


def test_no_tare_while_the_stop_is_latched(rig: Rig) -> None:
    rig.latched[0] = True
    with pytest.raises(Stopped):
        rig.controller.tare()
    assert rig.world.commands == []


def test_a_motion_that_ends_by_a_force_does_not_start_where_nothing_measures_it(rig: Rig) -> None:
    rig.controller._devices = replace(rig.controller._devices, force_torque=None)
    touch = Guard(name="contact", quantity=Quantity.FORCE, limit=5.0)
    with pytest.raises(MotionRefused, match="nothing measures the force"):
        rig.controller.execute(forwards(0.1, guards=(touch,)))
    assert rig.world.commands == []
