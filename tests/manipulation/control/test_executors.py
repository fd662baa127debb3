"""Tests of each kind of motion: its set-points per tick, its end, and its report."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hal.clock import SimClock
from hal.devices import ArmCapabilities
from hal.geometry import difference, perturbed
from hal.motion import CartesianPath, Compliance, GripperMotion, Hold, JointTrajectory
from manipulation.arm.kinematics import Kinematics
from manipulation.control.executors import (
    Admittance,
    Executor,
    GripperExecutor,
    HoldExecutor,
    PathExecutor,
    Tick,
    TrajectoryExecutor,
)
from manipulation.control.recorder import Recorder
from manipulation.control.sensing import Sample, command_wait_s
from manipulation.planning.cartesian_path import arc, line, through
from tests.manipulation.arms import SEVEN, T3, UR
from tests.manipulation.rig import GRIP, HOME, tool_pose

ARM = Kinematics.of(T3)
DT_S = 0.002
INF = float("inf")


def tick(
    elapsed_s: float, *, last_rad: np.ndarray = HOME, wrench: np.ndarray | None = None, pads_move: bool = False
) -> Tick:
    sample = Sample(
        stamp_s=elapsed_s,
        position_rad=HOME,
        velocity_rad_per_s=np.zeros(6),
        raw_wrench=np.zeros(6),
        contacts=(),
        proximity_m=(),
        gripper_width_m=0.0,
        gripper_is_moving=pads_move,
    )
    return Tick(elapsed_s, sample, np.zeros(6) if wrench is None else wrench, last_rad, DT_S)


# -- joints --------------------------------------------------------------------------------------------------------


def test_a_trajectory_starts_at_the_measured_joints_and_has_closed_the_gap_after_a_quarter_second() -> None:
    """The trajectory is a parabola, which cubic interpolation between its points reproduces exactly."""
    times, rate = np.array([0.0, 0.3, 1.0]), np.linspace(0.1, 0.6, 6)
    motion = JointTrajectory(
        name="joints",
        times_s=times,
        positions_rad=HOME + times[:, None] ** 2 * rate,
        velocities_rad_per_s=2.0 * times[:, None] * rate,
    )
    gap = np.full(6, 0.04)
    run = TrajectoryExecutor(motion, HOME + gap)
    for at_s, left in ((0.0, 1.0), (0.125, 0.5), (0.25, 0.0), (0.6, 0.0), (1.0, 0.0)):
        np.testing.assert_allclose(run.wanted(tick(at_s)), HOME + at_s**2 * rate + left * gap, atol=1e-12)
    assert not run.is_over(tick(0.999))
    assert run.is_over(tick(1.0))


# -- paths ---------------------------------------------------------------------------------------------------------


def a_path(compliance: Compliance | None = None) -> CartesianPath:
    """Return a path from `HOME` of 40 mm along the base's z in half a second."""
    start = tool_pose(HOME)
    poses = tuple(perturbed(start, np.array([0, 0, z, 0, 0, 0])) for z in (0.0, 0.02, 0.04))
    return CartesianPath(
        name="path", flange_from_tool=GRIP, times_s=np.array([0.0, 0.25, 0.5]), base_from_tool=poses,
        compliance=compliance,
    )  # fmt: skip


def followed(
    run: Executor, until_s: float, start_rad: np.ndarray, wrench: np.ndarray | None = None
) -> list[np.ndarray]:
    """Return the set-points of each tick from 0 to `until_s`; each is reached at once."""
    joints = [start_rad]
    for k in range(round(until_s / DT_S) + 1):
        joints.append(run.wanted(tick(k * DT_S, last_rad=joints[-1], wrench=wrench)))
    return joints[1:]


def test_a_path_starts_at_the_measured_tool_and_has_closed_the_gap_after_a_quarter_second() -> None:
    measured = HOME + np.array([0.004, -0.003, 0.002, 0.01, -0.01, 0.01])
    motion = a_path()
    joints = followed(PathExecutor(motion, ARM, measured), 0.5, measured)
    np.testing.assert_allclose(joints[0], measured, atol=1e-5)
    for at_s, pose in ((0.25, motion.base_from_tool[1]), (0.5, motion.base_from_tool[2])):
        reached = tool_pose(joints[round(at_s / DT_S)])
        np.testing.assert_allclose(difference(reached, pose), 0.0, atol=1e-5)
    run = PathExecutor(motion, ARM, HOME)
    assert not run.is_over(tick(0.499))
    assert run.is_over(tick(0.5))


def test_a_path_that_shifts_and_turns_is_at_each_of_its_poses_in_time() -> None:
    start = tool_pose(HOME)
    poses = tuple(perturbed(start, np.array([0, 0, 0.02 * k, 0.2 * k, 0, 0])) for k in range(4))
    times = np.array([0.0, 0.6, 1.2, 1.8])
    motion = CartesianPath(name="path", flange_from_tool=GRIP, times_s=times, base_from_tool=poses)
    joints = followed(PathExecutor(motion, ARM, HOME), 1.8, HOME)
    for at_s, pose in zip(times, poses, strict=True):
        np.testing.assert_allclose(difference(tool_pose(joints[round(at_s / DT_S)]), pose), 0.0, atol=1e-5)


@pytest.mark.parametrize("caps", [T3, UR, SEVEN], ids=lambda caps: caps.model)
@given(seed=st.integers(0, 10**6), speed=st.sampled_from([0.06, 0.15, 0.25]), is_arc=st.booleans())
@settings(max_examples=15, deadline=None)
def test_every_tick_of_any_stroke_keeps_the_limits_of_the_joints(
    caps: ArmCapabilities, seed: int, speed: float, is_arc: bool
) -> None:
    arm, rng = Kinematics.of(caps), np.random.default_rng(seed)
    start_rad = rng.uniform(-1.5, 1.5, len(arm.dh))
    start = arm.tool(start_rad, GRIP)
    if is_arc:
        centre = start.translation + rng.normal(0.0, 0.08, 3)
        poses = arc(start, centre_m=centre, axis=rng.normal(0.0, 1.0, 3), angle_rad=rng.uniform(0.2, 1.7))
        motion = through(poses, name="arc", speed_m_per_s=speed, flange_from_tool=GRIP)
    else:
        end = perturbed(start, rng.normal(0.0, 0.05, 6))
        motion = line(start, end, name="line", speed_m_per_s=speed, flange_from_tool=GRIP)
    run = PathExecutor(motion, arm, start_rad)
    joints = [start_rad] * 3
    while not run.is_over(tick(DT_S * (len(joints) - 4))):
        joints.append(run.wanted(tick(DT_S * (len(joints) - 3), last_rad=joints[-1])))
    assume(min(arm.conditioning(q) for q in joints[::20]) > 0.1)  # next to singularities strokes are refused
    sent = np.array([*joints, *[joints[-1]] * 3])
    assert (np.abs(np.diff(sent, axis=0)) / DT_S <= arm.velocity_rad_per_s).all()
    assert (np.abs(np.diff(sent, 2, axis=0)) / DT_S**2 <= arm.acceleration_rad_per_s2).all()
    assert (np.abs(np.diff(sent, 3, axis=0)) / DT_S**3 <= 1.2 * arm.jerk_rad_per_s3).all()


def test_a_compliant_path_yields_by_force_over_stiffness_along_the_tools_own_axis() -> None:
    soft = Compliance(
        stiffness=(1000.0, INF, INF, INF, INF, INF), damping=(200.0,) * 6, mass=(1.0,) * 6, max_offset_m=0.02
    )
    motion = a_path(soft)
    push = np.array([5.0, 7.0, -9.0, 0.3, 0.2, 0.1])
    end = tool_pose(followed(PathExecutor(motion, ARM, HOME), 2.0, HOME, push)[-1])
    goal = motion.base_from_tool[-1]
    np.testing.assert_allclose(goal.inv().apply(end.translation), [0.005, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose((goal.rotation.inv() * end.rotation).as_rotvec(), 0.0, atol=1e-5)


def test_an_admittance_moves_as_mass_damper_and_spring_do_towards_its_target_wrench() -> None:
    """Compares with the closed form of the overdamped oscillator, to 1 % because the integration is of first order."""
    m, d, k, f = 2.0, 80.0, 500.0, 4.0
    six = (k, INF, k, k, k, k)
    pull = Compliance(stiffness=six, damping=(d,) * 6, mass=(m,) * 6, target_wrench=(-1.0, 0, 0, 0, 0, 0))
    admittance, wrench = Admittance(pull), np.array([f - 1.0, 50.0, 0, 0, 0, 0])
    roots = np.roots([m, d, k])
    offsets = np.array([admittance.step(wrench, DT_S) for _ in range(200)])
    t = DT_S * np.arange(1, 201)
    decay = (roots[0] * np.exp(roots[1] * t) - roots[1] * np.exp(roots[0] * t)) / (roots[0] - roots[1])
    np.testing.assert_allclose(offsets[:, 0], f / k * (1.0 - decay), atol=0.015 * f / k)
    np.testing.assert_array_equal(offsets[:, 1:], 0.0)


@pytest.mark.parametrize(("axis", "bound"), [(0, 0.003), (4, 0.2)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_admittance_yields_no_further_than_its_bound_and_comes_back(axis: int, bound: float, sign: float) -> None:
    soft = Compliance(
        stiffness=(10.0,) * 6, damping=(2.0,) * 6, mass=(0.1,) * 6, max_offset_m=0.003, max_offset_rad=0.2
    )
    admittance, wrench = Admittance(soft), np.zeros(6)
    wrench[axis] = sign * 50.0
    for _ in range(500):
        offset = admittance.step(wrench, DT_S)
    assert offset[axis] == sign * bound
    for _ in range(5000):
        offset = admittance.step(np.zeros(6), DT_S)
    assert abs(offset[axis]) < 1e-3 * bound


# -- standing still ------------------------------------------------------------------------------------------------


class Pads:
    """Gripper that records its commands."""

    name = "gripper"

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []

    def command(self, **told: Any) -> float:
        self.told.append(told)
        return float(told["width_m"])


def test_a_hold_stays_where_it_is_for_its_time() -> None:
    run = HoldExecutor(Hold(name="hold", duration_s=0.1))
    np.testing.assert_array_equal(run.wanted(tick(0.05, last_rad=HOME + 0.1)), HOME + 0.1)
    assert not run.is_over(tick(0.0999))
    assert run.is_over(tick(0.1))


def test_a_gripper_motion_is_over_when_the_pads_have_rested_since_they_could_have_begun() -> None:
    pads, clock = Pads(), SimClock()
    motion = GripperMotion(name="grasp", width_m=0.02, force_n=30.0, speed_m_per_s=0.05, timeout_s=1.0)
    run = GripperExecutor(motion, pads, tick(0.0).sample, clock)
    (told,) = pads.told
    assert told.pop("deadline").remaining_s() == pytest.approx(command_wait_s(clock))
    assert told == {"width_m": 0.02, "force_n": 30.0, "speed_m_per_s": 0.05}
    np.testing.assert_array_equal(run.wanted(tick(0.5, last_rad=HOME + 0.1)), HOME + 0.1)

    def over(at_s: float, *, pads_move: bool) -> bool:
        return run.is_over(tick(at_s, pads_move=pads_move))

    assert not over(0.0, pads_move=False)
    assert not over(0.07, pads_move=False), "they may not have begun"
    assert not over(0.10, pads_move=True)
    assert not over(0.20, pads_move=False)
    assert not over(0.22, pads_move=True), "a pause is no end"
    assert not over(0.24, pads_move=False)
    assert not over(0.28, pads_move=False)
    assert over(0.30, pads_move=False)


def test_pads_that_never_rest_are_waited_for_until_the_timeout() -> None:
    motion = GripperMotion(name="grasp", width_m=0.02, force_n=30.0, timeout_s=1.0)
    run = GripperExecutor(motion, Pads(), tick(0.0).sample, SimClock())
    assert not run.is_over(tick(0.999, pads_move=True))
    assert run.is_over(tick(1.0, pads_move=True))


# -- the report ----------------------------------------------------------------------------------------------------


def test_the_log_keeps_every_fourth_tick_of_500_hz_and_the_peak_of_all() -> None:
    recorder = Recorder(DT_S)
    for k in range(10):
        wrench = np.array([0.0, 3.0, 4.0, 50.0, 0.0, 0.0]) if k == 5 else np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        recorder.note(k * DT_S, HOME + k, wrench, np.array([0.1 * k, 0.0, 0.0]))
    log = recorder.log(6)
    np.testing.assert_allclose(log.times_s, [0.0, 4 * DT_S, 8 * DT_S])
    np.testing.assert_array_equal(log.positions_rad, [HOME, HOME + 4, HOME + 8])
    np.testing.assert_allclose(log.tip_m[:, 0], [0.0, 0.4, 0.8])
    assert log.wrench.shape == (3, 6)
    assert recorder.peak_force_n == 5.0


def test_a_slow_controller_logs_every_tick_and_one_that_never_ran_has_empty_rows() -> None:
    recorder = Recorder(0.008)
    empty = recorder.log(6)
    assert (empty.times_s.shape, empty.positions_rad.shape, empty.wrench.shape, empty.tip_m.shape) == (
        (0,), (0, 6), (0, 6), (0, 3),
    )  # fmt: skip
    for k in range(3):
        recorder.note(0.008 * k, HOME, np.zeros(6), np.zeros(3))
    assert len(recorder.log(6).times_s) == 3
