from __future__ import annotations

import re
import threading
from dataclasses import replace

import numpy as np
import pytest

from hal.errors import MotionRefused
from hal.geometry import difference, perturbed
from hal.motion import (
    CartesianPath,
    Compliance,
    GripperMotion,
    Guard,
    Hold,
    JointTrajectory,
    MotionOutcome,
    Quantity,
)
from manipulation.control import termination
from manipulation.planning.cartesian_path import line
from tests.manipulation.rig import GRIP, HOME, LOAD, FakeGripper, Rig, make_rig, tool_pose

INF = float("inf")


def forwards(
    distance_m: float,
    *,
    speed: float = 0.06,
    start: np.ndarray = HOME,
    guards: tuple[Guard, ...] = (),
    compliance: Compliance | None = None,
) -> CartesianPath:
    pose = tool_pose(start)
    return line(
        pose,
        perturbed(pose, np.array([distance_m, 0, 0, 0, 0, 0])),
        name="forwards",
        speed_m_per_s=speed,
        flange_from_tool=GRIP,
        guards=guards,
        compliance=compliance,
    )


def joints(goal: np.ndarray, duration_s: float = 2.0) -> JointTrajectory:
    t = np.linspace(0, 1, 20)
    u = t * t * (3 - 2 * t)
    du = 6 * t * (1 - t) / duration_s
    return JointTrajectory(
        name="joints",
        times_s=t * duration_s,
        positions_rad=HOME + u[:, None] * (goal - HOME),
        velocities_rad_per_s=du[:, None] * (goal - HOME),
    )


def test_a_path_ends_where_it_was_declared(rig: Rig) -> None:
    motion = forwards(0.05)
    report = rig.controller.execute(motion)
    assert report.outcome is MotionOutcome.COMPLETED
    assert np.linalg.norm(difference(motion.base_from_tool[-1], report.base_from_tool)) < 1e-4
    assert report.duration_s == pytest.approx(motion.times_s[-1], abs=0.1)
    assert report.log.positions_rad.shape[1] == 6 and len(report.log.times_s) > 20
    assert report.peak_force_n < 0.05


def test_a_trajectory_ends_where_it_was_declared_and_begins_at_the_measured_joints(rig: Rig) -> None:
    goal = HOME + np.array([0.2, -0.1, 0.1, 0.3, -0.2, 0.4])
    rig.world.q = rig.world.target = HOME + 0.02
    report = rig.controller.execute(joints(goal))
    assert report.outcome is MotionOutcome.COMPLETED
    assert np.abs(report.position_rad - goal).max() < 1e-3
    assert np.abs(rig.world.commands[0] - (HOME + 0.02)).max() < 1e-3


@pytest.mark.parametrize(
    ("joint", "leap_rad", "cause"),
    [(0, 0.2, "declared end$"), (0, 1.5, "declared end$"), (5, 2.0, r"joint 6 is still \d+\.\d mrad away")],
)
def test_a_set_point_that_the_limits_hold_back_is_waited_for_and_what_is_left_is_told(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, joint: int, leap_rad: float, cause: str
) -> None:
    """A turn of the hand about its own axis leaves the tip where it is, so that the motion does not wait for it."""
    if joint == 5:
        monkeypatch.setattr(termination, "CATCH_UP_S", 0.1)
    goal = HOME.copy()
    goal[joint] += leap_rad
    times = np.array([0.0, 0.01, 0.02])
    leap = JointTrajectory(
        name="leap", times_s=times, positions_rad=np.array([HOME, HOME, goal]), velocities_rad_per_s=np.zeros((3, 6))
    )
    report = rig.controller.execute(leap)
    assert report.outcome is MotionOutcome.COMPLETED
    assert re.search(cause, report.cause)
    assert report.ended_s - report.started_s > (0.3 if joint == 0 else 0.1)
    assert (np.abs(report.position_rad - goal).max() < 2e-3) == (joint == 0)


@pytest.mark.parametrize("stall_s", [0.02, 0.05, 0.2])
def test_a_machine_that_stands_still_makes_a_motion_late_and_not_fast(rig: Rig, stall_s: float) -> None:
    def stall() -> None:
        if rig.world.ticks == 200:
            rig.world.clock.set_now_s(rig.world.clock.now_s() + stall_s)

    rig.world.before_step = stall
    motion = forwards(0.05)
    report = rig.controller.execute(motion)
    assert report.outcome is MotionOutcome.COMPLETED
    tips = np.array([tool_pose(q).translation for q in rig.world.commands])
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / 0.002 <= 1.7 * 0.06
    assert np.diff(tips[:, 0]).min() >= -1e-9, "and it never goes back"
    assert np.linalg.norm(difference(report.base_from_tool, motion.base_from_tool[-1])[:3]) < 1e-4
    assert report.ended_s - report.started_s >= motion.times_s[-1] + stall_s - 0.002


def test_contact_stops_an_approach_close_to_the_wall(rig: Rig) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.03
    guard = Guard(name="contact", quantity=Quantity.FORCE, limit=8.0)
    report = rig.controller.execute(forwards(0.08, guards=(guard,)))
    assert report.outcome is MotionOutcome.GUARD and report.tripped == "contact"
    assert 8.0 <= report.peak_force_n < 14.0
    assert report.base_from_tool.translation[0] - rig.world.wall_x_m < 0.003


def test_the_contact_wrench_is_free_of_weight_and_bias_and_in_tool_axes(rig: Rig) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) - 0.002
    report = rig.controller.execute(Hold(name="look", duration_s=0.02))
    force = tool_pose(HOME).rotation.inv().apply([-0.002 * rig.world.wall_n_per_m, 0, 0])
    assert np.allclose(report.wrench[:3], force, atol=1e-6)
    assert np.allclose(report.wrench[3:], 0.0, atol=1e-6)  # the wall acts at the tip


def test_tare_finds_the_bias(rig: Rig) -> None:
    assert np.allclose(rig.controller.tare(), LOAD.bias, atol=1e-9)


@pytest.mark.parametrize(
    ("quantity", "limit", "axis", "below"),
    [
        (Quantity.TRAVEL, 0.02, None, False),
        (Quantity.PROXIMITY, 0.03, None, True),
        (Quantity.TOUCH, 1, None, False),
        (Quantity.FORCE_RISE, 5.0, None, False),
        (Quantity.TORQUE, -1.0, None, False),
    ],
)
def test_every_quantity_can_end_a_motion(
    rig: Rig, quantity: Quantity, limit: float, axis: tuple[float, float, float] | None, below: bool
) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.05
    guard = Guard(name="it", quantity=quantity, limit=limit, axis=axis, below=below)
    report = rig.controller.execute(forwards(0.1, guards=(guard,)))
    assert (report.outcome, report.tripped) == (MotionOutcome.GUARD, "it")


def test_rotation_ends_a_turn(rig: Rig) -> None:
    pose = tool_pose(HOME)
    motion = line(
        pose,
        perturbed(pose, np.array([0, 0, 0, 0.4, 0, 0])),
        name="turn",
        speed_m_per_s=0.02,
        flange_from_tool=GRIP,
        guards=(Guard(name="turned", quantity=Quantity.ROTATION, limit=0.2),),
    )
    report = rig.controller.execute(motion)
    assert report.tripped == "turned"
    assert np.linalg.norm(difference(report.base_from_tool, pose)[3:]) == pytest.approx(0.2, abs=0.01)


def test_too_much_force_is_a_fault_in_any_motion(rig: Rig) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.01
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.FAULT and report.tripped == "force_limit"
    assert report.peak_force_n < 130.0


def test_a_frozen_force_sensor_ends_a_motion_before_the_wall_is_pressed_hard(rig: Rig) -> None:
    """Without this check a mission pressed with 1029 N."""
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.01
    rig.world.repeating.add("wrist_ft")
    report = rig.controller.execute(forwards(0.1))
    assert (report.outcome, report.device) == (MotionOutcome.FAULT, "wrist_ft")
    assert np.linalg.norm(rig.world.contact_force()) < 60.0
    rig.world.repeating.clear()
    assert rig.controller.execute(Hold(name="wait", duration_s=0.01)).outcome is MotionOutcome.COMPLETED


def test_compliance_yields_to_the_wall(rig: Rig) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) + 0.02
    soft = Compliance(stiffness=(300.0,) * 3 + (INF,) * 3, damping=(100.0,) * 6, mass=(2.0,) * 6)
    report = rig.controller.execute(forwards(0.04, speed=0.02, compliance=soft))
    # 20 mm beyond the wall, springs of 300 and 5000 N/m in series press with 5.7 N; a stiff arm would press with 100 N.
    assert report.outcome is MotionOutcome.COMPLETED
    assert np.linalg.norm(report.wrench[:3]) == pytest.approx(0.02 / (1 / 300 + 1 / 5000), rel=0.15)


def test_cancel_ends_the_motion(rig: Rig) -> None:
    rig.world.before_step = lambda: rig.controller.cancel() if rig.world.ticks == 150 else None
    report = rig.controller.execute(forwards(0.1))
    assert report.outcome is MotionOutcome.CANCELLED
    assert rig.controller.execute(Hold(name="still", duration_s=0.02)).outcome is MotionOutcome.COMPLETED


def test_a_motion_that_begins_while_the_controller_closes_is_cancelled_too(rig: Rig) -> None:
    closing = threading.Thread(target=rig.controller.close)

    def close() -> None:
        if rig.world.ticks == 150:
            closing.start()
            assert rig.controller._cancel.wait(10.0)
            rig.controller._cancel.clear()  # as `execute` does if it runs between the cancel and the thread's end

    rig.world.before_step = close
    report = rig.controller.execute(forwards(0.1))
    closing.join(10.0)
    assert report.outcome is MotionOutcome.CANCELLED


def test_set_points_never_break_the_limits_even_when_a_path_asks_for_it(rig: Rig) -> None:
    rig.controller.execute(forwards(0.12, speed=2.0))
    commands = np.array(rig.world.commands)
    velocity = np.diff(commands, axis=0) / 0.002
    tips = np.array([tool_pose(q).translation for q in commands])
    assert np.all(np.abs(velocity) <= 3.2 + 1e-6)
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / 0.002 <= 0.2505


@pytest.mark.parametrize(
    "motion",
    [
        forwards(0.1, start=HOME + 0.2),
        joints(HOME + 5.0),
        joints(HOME + np.nan),
        joints(HOME + 1.0, duration_s=0.1),
        Hold(name="long", duration_s=float("nan")),
        GripperMotion(name="wide", width_m=-1.0, force_n=1.0),
        replace(joints(HOME), pads=GripperMotion(name="wide", width_m=-1.0, force_n=1.0)),
        CartesianPath(name="empty", flange_from_tool=GRIP, times_s=np.array([0.0]), base_from_tool=(tool_pose(HOME),)),
    ],
    ids=lambda motion: motion.name,
)  # fmt: skip
def test_nonsense_is_refused_and_nothing_moves(rig: Rig, motion: CartesianPath) -> None:
    with pytest.raises(MotionRefused):
        rig.controller.execute(motion)
    assert rig.world.commands == []


def test_a_second_motion_at_the_same_time_is_refused(rig: Rig) -> None:
    running, release = threading.Event(), threading.Event()

    def wait() -> None:
        running.set()
        release.wait(5.0)

    rig.world.before_step = wait
    first = threading.Thread(target=lambda: rig.controller.execute(Hold(name="long", duration_s=0.1)))
    first.start()
    assert running.wait(5.0)
    with pytest.raises(MotionRefused, match="another motion"):
        rig.controller.execute(Hold(name="second", duration_s=0.1))
    release.set()
    first.join()


def test_the_gripper_moves_while_the_arm_holds(rig: Rig) -> None:
    report = rig.controller.execute(GripperMotion(name="close", width_m=0.01, force_n=10.0))
    assert report.outcome is MotionOutcome.COMPLETED
    assert report.gripper_width_m == pytest.approx(0.01, abs=1e-4)
    assert np.allclose(rig.world.q, HOME)


@pytest.mark.parametrize("last", ["arm", "pads"])
def test_the_pads_move_during_a_trajectory_and_both_arrive(rig: Rig, last: str) -> None:
    goal = HOME + np.array([0.2, -0.1, 0.1, 0.3, -0.2, 0.4]) * (1.0 if last == "arm" else 0.1)
    pads = GripperMotion(name="close", width_m=0.01, force_n=10.0)
    motion = joints(goal, duration_s=1.5 if last == "arm" else 0.2)
    report = rig.controller.execute(replace(motion, pads=pads))
    assert report.outcome is MotionOutcome.COMPLETED
    assert report.gripper_width_m == pytest.approx(0.01, abs=1e-4)
    assert np.abs(report.position_rad - goal).max() < 1e-3
    assert (report.duration_s > motion.times_s[-1] + 0.1) == (last == "pads")


def test_the_arm_is_at_rest_and_its_drives_are_off_before_a_gripper_that_may_hang_is_asked_to_stop(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[bool, float]] = []

    def command(_gripper: FakeGripper, *, width_m: float, **_given: object) -> float:
        asked.append((rig.world.enabled, float(np.abs(rig.world.velocity).max())))
        rig.world.width_target_m = width_m
        return width_m

    monkeypatch.setattr(FakeGripper, "command", command)
    begun = rig.world.ticks

    def stop() -> None:
        rig.latched[0] = rig.world.ticks - begun >= 100

    rig.world.before_step = stop
    pads = GripperMotion(name="close", width_m=0.01, force_n=10.0)
    motion = replace(joints(HOME + 0.2, duration_s=1.5), pads=pads)
    assert rig.controller.execute(motion).outcome is MotionOutcome.STOPPED
    assert len(asked) == 2, "it was asked to close, then to stop"
    is_on, fastest = asked[1]
    assert (is_on, fastest < 1e-3) == (False, True)


@pytest.mark.parametrize("ticks", [0, 3, 100])
@pytest.mark.parametrize("how", ["stop", "cancel"])
def test_the_pads_stop_with_the_motion(rig: Rig, how: str, ticks: int) -> None:
    begun = rig.world.ticks

    def end() -> None:
        if rig.world.ticks - begun == ticks:
            rig.latched[0] = how == "stop"
            rig.controller.cancel()

    rig.world.before_step = end
    report = rig.controller.execute(GripperMotion(name="close", width_m=0.0, force_n=20.0, speed_m_per_s=0.05))
    assert report.outcome is (MotionOutcome.STOPPED if how == "stop" else MotionOutcome.CANCELLED)
    where_m = rig.world.width_m
    rig.world.clock.sleep(1.0)
    assert abs(rig.world.width_m - where_m) < 0.002
    assert rig.world.width_m > 0.02


@pytest.mark.parametrize("fails", ["silent", "defective"])
def test_a_gripper_that_does_not_hear_hinders_no_stop(rig: Rig, fails: str) -> None:
    def break_and_stop() -> None:
        if rig.world.ticks == 20:
            getattr(rig.world, fails).add("gripper")
            rig.latched[0] = True

    rig.world.before_step = break_and_stop
    motion = GripperMotion(name="close", width_m=0.0, force_n=20.0, speed_m_per_s=0.05)
    assert rig.controller.execute(motion).outcome in (MotionOutcome.STOPPED, MotionOutcome.FAULT)
    assert not rig.world.enabled


def test_the_state_tells_joints_contacts_and_the_latch(rig: Rig) -> None:
    rig.world.wall_x_m = float(tool_pose(HOME).translation[0]) - 0.001
    rig.latched[0] = True
    state = rig.controller.state()
    assert np.array_equal(state.position_rad, HOME)
    assert state.contacts == (True, False) and state.is_stopped and not state.is_moving
    assert np.linalg.norm(state.wrench[:3]) == pytest.approx(5.0, rel=1e-6)


def test_the_state_tells_that_a_device_fell_silent_between_motions(rig: Rig) -> None:
    assert rig.controller.state().faults == ()
    rig.world.silent.add("wrist_ft")
    assert rig.controller.state().faults == ("wrist_ft silent",)
    rig.world.silent.clear()
    assert rig.controller.state().faults == ()


def test_a_closed_controller_refuses_and_closes_twice() -> None:
    rig = make_rig()
    rig.controller.close()
    rig.controller.close()
    with pytest.raises(MotionRefused):
        rig.controller.execute(Hold(name="late", duration_s=0.1))
