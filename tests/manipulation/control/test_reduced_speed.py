"""Speed and force limits of people near, and of one motion, are kept by the control thread itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.clock import Deadline
from hal.config import SafetySection
from hal.errors import DeviceTimeout
from hal.motion import DeclaredMotion, GripperMotion, MotionLimits, MotionOutcome
from manipulation.control.termination import TRANSFER_FORCE_N, force_limit_n
from tests.manipulation.control.test_controller import forwards, joints
from tests.manipulation.rig import HOME, FakeArm, Rig, make_rig, tool_pose

SLACK = 1.002
TURN = np.array([0.5, -0.2, 0.1, 0.3, -0.2, 0.4])
MOTIONS = (forwards(0.12, speed=0.2), joints(HOME + TURN))


def speeds_m_per_s(rig: Rig) -> np.ndarray:
    """Return the speed of the tip between the set-points that were sent."""
    tips = np.array([tool_pose(q).translation for q in rig.world.commands])
    return np.asarray(np.linalg.norm(np.diff(tips, axis=0), axis=1) / 0.002)


def way_off_m(rig: Rig, motion: DeclaredMotion) -> float:
    """Return how far a set-point, of every tenth, was from the way that the same motion takes at full speed."""
    full = make_rig()
    full.controller.execute(motion)
    full.controller.close()
    way = np.array([tool_pose(q).translation for q in full.world.commands])
    gone = np.array([tool_pose(q).translation for q in rig.world.commands[::10]])
    return max(float(np.linalg.norm(way - place, axis=1).min()) for place in gone)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
@pytest.mark.parametrize("limit_m_per_s", [0.05, 0.1])
def test_while_people_are_near_a_motion_takes_its_way_at_the_reduced_speed(
    motion: DeclaredMotion, limit_m_per_s: float
) -> None:
    rig = make_rig(safety=SafetySection(reduced_speed_m_per_s=limit_m_per_s))
    rig.near[0] = True
    report = rig.controller.execute(motion)
    rig.controller.close()
    assert report.outcome is MotionOutcome.COMPLETED and report.cause.endswith("declared end")
    assert speeds_m_per_s(rig).max() <= SLACK * limit_m_per_s
    assert way_off_m(rig, motion) < 0.001


@pytest.mark.parametrize("motion", [*MOTIONS, forwards(0.12, speed=2.0)], ids=lambda motion: motion.name)
@pytest.mark.parametrize(("own_m_per_s", "kept_m_per_s"), [(0.05, 0.05), (1.0, 0.25)])
def test_a_motion_may_have_a_speed_limit_of_its_own_and_cannot_raise_that_of_the_cell(
    rig: Rig, motion: DeclaredMotion, own_m_per_s: float, kept_m_per_s: float
) -> None:
    limited = replace(motion, limits=MotionLimits(speed_m_per_s=own_m_per_s))
    assert rig.controller.execute(limited).outcome is MotionOutcome.COMPLETED
    assert speeds_m_per_s(rig).max() <= SLACK * kept_m_per_s


@pytest.mark.parametrize("share", [0.97, 0.6])
def test_a_motion_that_asks_for_more_than_the_speed_of_the_cell_keeps_its_way(rig: Rig, share: float) -> None:
    """Each joint was slowed by its own share, and an arm that lagged cut the corner of its way."""
    slow = joints(HOME + TURN, 1.0)
    rig.controller.execute(slow)
    duration_s = share * float(np.max(speeds_m_per_s(rig))) / 0.25
    other = make_rig()
    report = other.controller.execute(joints(HOME + TURN, duration_s))
    other.controller.close()
    assert report.outcome is MotionOutcome.COMPLETED
    assert speeds_m_per_s(other).max() <= SLACK * 0.25
    assert way_off_m(other, joints(HOME + TURN, 4.0)) < 0.001


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_people_who_come_slow_a_running_motion_down_and_it_goes_on_when_they_have_gone(
    rig: Rig, motion: DeclaredMotion
) -> None:
    def come_and_go() -> None:
        rig.near[0] = 150 <= rig.world.ticks < 300

    rig.world.before_step = come_and_go
    report = rig.controller.execute(motion)
    speeds = speeds_m_per_s(rig)
    assert report.outcome is MotionOutcome.COMPLETED
    assert speeds[:150].max() > 0.11
    assert speeds[210:300].max() <= SLACK * 0.1, "0.25 m/s are slowed down within 0.1 s"
    assert speeds[300:].max() > 0.11
    joint_steps = np.diff(np.array(rig.world.commands), axis=0) / 0.002
    rates = np.abs(np.diff(joint_steps, axis=0)).max() / 0.002
    assert rates <= SLACK * rig.controller.kinematics.acceleration_rad_per_s2.max()
    assert way_off_m(rig, motion) < 0.001


@pytest.mark.parametrize(("own_n", "least_n", "most_n"), [(20.0, 10.0, 30.0), (900.0, 60.0, 130.0)])
def test_a_motion_may_press_less_than_the_cell_allows_and_never_more(
    rig: Rig, own_n: float, least_n: float, most_n: float
) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.01
    report = rig.controller.execute(replace(forwards(0.1), limits=MotionLimits(force_n=own_n)))
    assert (report.outcome, report.tripped) == (MotionOutcome.FAULT, "force_limit")
    assert least_n < report.peak_force_n < most_n


def test_a_transfer_never_presses_more_than_a_transfer_may() -> None:
    assert force_limit_n(joints(HOME), 100.0) == TRANSFER_FORCE_N
    assert force_limit_n(replace(joints(HOME), limits=MotionLimits(force_n=12.0)), 100.0) == 12.0


def test_a_stop_that_holds_leaves_the_drives_on_and_one_that_switches_off_does_not(rig: Rig) -> None:
    for is_held in (True, False):
        rig.held[0], rig.latched[0] = is_held, False
        begun = rig.world.ticks

        def stop(begun: int = begun) -> None:
            rig.latched[0] = rig.world.ticks - begun >= 50

        rig.world.before_step = stop
        assert rig.controller.execute(forwards(0.1, start=rig.world.q)).outcome is MotionOutcome.STOPPED
        assert rig.world.enabled is is_held
        assert rig.controller.not_stopped() == ()


@pytest.mark.parametrize("fails", ["silent", "defective"])
def test_a_stop_reaches_arm_and_gripper_though_one_of_them_fails_and_that_one_is_named(rig: Rig, fails: str) -> None:
    begun = rig.world.ticks

    def break_and_stop() -> None:
        if rig.world.ticks - begun == 20:
            getattr(rig.world, fails).add("gripper")
            rig.latched[0] = True

    rig.world.before_step = break_and_stop
    rig.controller.execute(GripperMotion(name="close", width_m=0.0, force_n=20.0, speed_m_per_s=0.05))
    assert not rig.world.enabled, "the arm was switched off"
    assert [why.partition(":")[0] for why in rig.controller.not_stopped()] == ["gripper"]


@pytest.mark.parametrize(
    "error", [DeviceTimeout("arm is silent", hint="check its cable"), ZeroDivisionError("a defect")], ids=repr
)
def test_pads_are_stopped_though_the_arm_does_not_obey_and_the_arm_is_named(
    rig: Rig, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop_fails(_self: FakeArm, *, deadline: Deadline) -> None:
        raise error

    def latch() -> None:
        rig.latched[0] = rig.latched[0] or rig.world.ticks == 20

    monkeypatch.setattr(FakeArm, "stop", stop_fails)
    rig.world.before_step = latch
    motion = GripperMotion(name="close", width_m=0.0, force_n=20.0, speed_m_per_s=0.05)
    assert rig.controller.execute(motion).outcome is MotionOutcome.STOPPED
    where_m = rig.world.width_m
    rig.world.clock.sleep(1.0)
    assert abs(rig.world.width_m - where_m) < 0.002 and where_m > 0.02
    assert [why.partition(":")[0] for why in rig.controller.not_stopped()] == ["arm"]
