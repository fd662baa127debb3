"""Tests of the checks before a motion, each at its limit, and of the set-points that the final filter sends."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from hal.errors import MotionRefused
from hal.geometry import perturbed
from hal.motion import CartesianPath, Compliance, DeclaredMotion, GripperMotion, Guard, Hold, JointTrajectory, Quantity
from manipulation.arm.kinematics import Kinematics
from manipulation.control.sensing import DeviceFailure
from manipulation.control.setpoint import SetPointLimiter, check, check_is_felt, flange_matrix
from tests.manipulation.arms import T3
from tests.manipulation.rig import GRIP, HOME, tool_pose

ARM = Kinematics.of(T3)
DT_S = 0.002
POSE = tool_pose(HOME)
NAN = float("nan")

TRAJECTORY = JointTrajectory(
    name="joints",
    times_s=np.array([0.0, 1.0]),
    positions_rad=np.array([HOME, HOME + 0.1]),
    velocities_rad_per_s=np.zeros((2, 6)),
)
PATH = CartesianPath(name="path", flange_from_tool=GRIP, times_s=np.array([0.0, 1.0]), base_from_tool=(POSE, POSE))
HOLD = Hold(name="hold", duration_s=1.0)
GRASP = GripperMotion(name="grasp", width_m=0.01, force_n=1.0)


def with_joint(array: np.ndarray, row: int, value: float) -> np.ndarray:
    """Return a copy with another value for the last joint of one row."""
    out = array.copy()
    out[row, -1] = value
    return out


def shifted(*six: float) -> CartesianPath:
    """Return the path shifted from the tool's pose by m and rad."""
    return replace(PATH, base_from_tool=(perturbed(POSE, np.array(six)), POSE))


UPPER, LOWER = T3.upper_rad[-1], T3.lower_rad[-1]
FASTEST = T3.velocity_rad_per_s[-1]
POSITIONS, STILL = TRAJECTORY.positions_rad, TRAJECTORY.velocities_rad_per_s


@pytest.mark.parametrize(
    "motion",
    [
        TRAJECTORY,
        replace(TRAJECTORY, positions_rad=with_joint(POSITIONS, 1, UPPER)),
        replace(TRAJECTORY, positions_rad=with_joint(POSITIONS, 1, LOWER)),
        replace(TRAJECTORY, velocities_rad_per_s=with_joint(STILL, 1, -1.04 * FASTEST)),
        replace(TRAJECTORY, positions_rad=POSITIONS + 0.049),
        PATH,
        shifted(0.0029, 0.0029, 0.0, 0.0, 0.0, 0.0),
        shifted(0.0, 0.0, 0.0, 0.049, 0.0, 0.0),
        replace(HOLD, duration_s=0.0),
        replace(HOLD, duration_s=60.0),
        replace(GRASP, width_m=0.0, force_n=0.0, speed_m_per_s=0.0, timeout_s=0.0),
    ],
)
def test_what_can_be_meant_is_let_through(motion: DeclaredMotion) -> None:
    check(motion, ARM, HOME)


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (replace(TRAJECTORY, positions_rad=POSITIONS[:, :5]), "for times and joints"),
        (replace(TRAJECTORY, positions_rad=POSITIONS[:1]), "for times and joints"),
        (replace(TRAJECTORY, velocities_rad_per_s=STILL[:1]), "for times and joints"),
        (replace(TRAJECTORY, times_s=np.array([0.0, NAN])), "times must be finite"),
        (replace(TRAJECTORY, times_s=np.array([0.0, 0.0])), "times must be finite"),
        (replace(TRAJECTORY, times_s=np.array([1.0, 2.0])), "times must be finite"),
        (replace(TRAJECTORY, times_s=np.array([-1.0, 1.0])), "times must be finite"),
        (replace(TRAJECTORY, positions_rad=with_joint(POSITIONS, 1, NAN)), "is not finite"),
        (replace(TRAJECTORY, velocities_rad_per_s=with_joint(STILL, 1, NAN)), "is not finite"),
        (replace(TRAJECTORY, positions_rad=with_joint(POSITIONS, 1, UPPER + 1e-4)), "outside the joint range"),
        (replace(TRAJECTORY, positions_rad=with_joint(POSITIONS, 1, LOWER - 1e-4)), "outside the joint range"),
        (replace(TRAJECTORY, velocities_rad_per_s=with_joint(STILL, 0, -1.06 * FASTEST)), "above the joint limit"),
        (replace(TRAJECTORY, positions_rad=POSITIONS - 0.051), "starts 0.051 rad away"),
        (replace(PATH, times_s=np.array([0.0]), base_from_tool=(POSE,)), "times must be finite"),
        (replace(PATH, base_from_tool=(POSE,)), "1 poses for 2 times"),
        (replace(PATH, base_from_tool=(POSE, RigidTransform.from_translation([NAN, 0.0, 0.0]))), "is not finite"),
        (shifted(0.0036, 0.0036, 0.0, 0.0, 0.0, 0.0), "starts 5.1 mm"),
        (shifted(0.0, 0.0, 0.0, 0.0, 0.051, 0.0), "0.051 rad from the tool"),
        (replace(HOLD, duration_s=-0.001), "a hold of"),
        (replace(HOLD, duration_s=60.1), "a hold of"),
        (replace(HOLD, duration_s=NAN), "a hold of"),
        *((replace(GRASP, **{key: bad}), "negative or not finite")
          for key in ("width_m", "force_n", "speed_m_per_s", "timeout_s") for bad in (-1e-6, NAN)),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_with_the_reason_and_the_motion_named(
    motion: DeclaredMotion, says: str
) -> None:
    with pytest.raises(MotionRefused, match=f"motion '{motion.name}' refused: .*{says}") as caught:
        check(motion, ARM, HOME)
    assert caught.value.details["motion"] == motion.name


def made_filter(**given: Any) -> SetPointLimiter:
    out = SetPointLimiter(ARM, flange_matrix(GRIP), given.get("tip_limit_m_per_s", 10.0), DT_S)
    out.begin_at(given.get("start", HOME))
    return out


def test_the_filter_begins_at_rest_at_the_measured_joints_or_at_their_limit() -> None:
    beyond = np.full(6, 3.0)
    made = made_filter(start=beyond)
    np.testing.assert_array_equal(made.last_rad, np.full(6, UPPER))
    assert made.is_at_rest
    np.testing.assert_array_equal(made_filter(start=-beyond).last_rad, np.full(6, LOWER))


def test_the_filter_keeps_count_of_what_was_really_sent() -> None:
    made = made_filter()
    made.sent(HOME + 1e-4)
    np.testing.assert_allclose(made.velocity_rad_per_s, 0.05)
    np.testing.assert_array_equal(made.last_rad, HOME + 1e-4)
    assert not made.is_at_rest
    made.sent(HOME + 1e-4)
    assert made.is_at_rest
    made.sent(HOME - 1e-4)
    assert not made.is_at_rest, "backwards is a motion too"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_leap_becomes_a_ramp_that_uses_speed_and_acceleration_to_their_limits(sign: float) -> None:
    made, velocity, acceleration = made_filter(), np.array(T3.velocity_rad_per_s), np.array(T3.acceleration_rad_per_s2)
    for tick in range(1, 150):
        made.sent(made.apply(HOME + sign * 1.0))
        expected = np.minimum(velocity, tick * acceleration * DT_S)
        np.testing.assert_allclose(made.velocity_rad_per_s, sign * expected, atol=1e-9)


def test_what_stays_within_the_limits_is_sent_as_it_is() -> None:
    made, ways = made_filter(), 0.05 * (1.0 - np.cos(np.linspace(0.0, np.pi, 300)))
    for way in ways:
        made.sent(made.apply(HOME + way))
        np.testing.assert_allclose(made.last_rad, HOME + way, atol=1e-12)


def test_the_filter_sends_nothing_beyond_the_joint_range_nor_above_the_speed_of_the_tip() -> None:
    made = made_filter(start=np.full(6, UPPER - 0.001))
    for _ in range(300):
        made.sent(made.apply(np.full(6, 4.0)))
    np.testing.assert_allclose(made.last_rad, UPPER)
    made = made_filter(tip_limit_m_per_s=0.05)
    tips = [tool_pose(HOME).translation]
    for _ in range(100):
        made.sent(made.apply(HOME + 0.5))
        tips.append(tool_pose(made.last_rad).translation)
    fastest = np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / DT_S
    assert 0.049 <= fastest <= 0.0505


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_joint_that_reaches_its_limit_too_fast_to_brake_is_not_sent_beyond_it(sign: float) -> None:
    made = made_filter(start=np.full(6, sign * (UPPER - 0.004)))
    made.sent(np.full(6, sign * (UPPER - 0.0005)))  # 1.75 rad/s
    np.testing.assert_array_equal(made.apply(np.full(6, sign * 4.0)), np.full(6, sign * UPPER))
    np.testing.assert_array_equal(made.brake(), np.full(6, sign * UPPER))


VELOCITY, ACCELERATION = np.array(T3.velocity_rad_per_s), np.array(T3.acceleration_rad_per_s2)
FREE_TIP_M_PER_S = 10.0
A_SHORT_LEAP_RAD = 5e-4  # a jump completed within the ticks looked back on counts as a trajectory: v^2 / 2a


def driven(made: SetPointLimiter, wanted: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N + 1, 6) and accelerations (N, 6) of the filter for a trajectory."""
    ways, speeds = [made.last_rad], [made.velocity_rad_per_s]
    for joints in wanted:
        made.sent(made.apply(joints))
        ways.append(made.last_rad)
        speeds.append(made.velocity_rad_per_s)
    assert (np.abs(speeds) <= VELOCITY * (1.0 + 1e-9)).all()
    return np.array(ways), np.diff(speeds, axis=0) / DT_S


@settings(max_examples=40)
@given(leap=st.lists(st.floats(-0.8, 0.8), min_size=6, max_size=6), is_tip_limited=st.booleans())
def test_behind_a_leap_the_arm_brakes_in_time_and_rests_where_it_was_wanted(
    leap: list[float], is_tip_limited: bool
) -> None:
    goal = HOME + np.array(leap)
    made = made_filter(tip_limit_m_per_s=0.25 if is_tip_limited else FREE_TIP_M_PER_S)
    joints, accelerations = driven(made, itertools.repeat(goal, 3500))
    np.testing.assert_allclose(joints[-2:], [goal, goal], atol=1e-9)
    past_rad = ((joints - goal) * np.sign(leap)).max()
    if is_tip_limited:  # the limit of the tip slows all joints, so some overshoot slightly; without braking 0.3 rad
        assert past_rad <= 0.1
    else:
        assert past_rad <= A_SHORT_LEAP_RAD
        assert (np.abs(accelerations) <= ACCELERATION * (1.0 + 1e-6)).all()


def test_a_motion_does_not_wait_for_ever_for_a_set_point_that_comes_no_nearer() -> None:
    made = made_filter()
    made.begin_at(HOME)
    made.sent(HOME + 1e-3)  # not at rest
    ahead, near = made.last_rad + 0.3, made.last_rad + 1e-4
    waited = [made.waiting_share(ahead, made.last_rad) for _ in range(round(2.0 / DT_S))]
    assert waited[: round(0.9 / DT_S)] == [1.0] * round(0.9 / DT_S)
    assert waited[round(1.1 / DT_S) :] == [0.0] * (len(waited) - round(1.1 / DT_S))
    assert 0.0 < made.waiting_share(near, made.last_rad) < 1.0
    assert made.waiting_share(ahead, made.last_rad) == 1.0, "after progress it waits again"


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), held=st.integers(1, 200))
def test_whatever_leaps_the_arm_keeps_its_range_and_never_brakes_harder_than_it_may(seed: int, held: int) -> None:
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-4.0, 4.0, (1500 // held + 1, 6)), held, axis=0)
    joints, accelerations = driven(made_filter(), goals)
    assert (np.abs(joints) <= UPPER).all()
    assert (np.abs(accelerations) <= ACCELERATION * (1.0 + 1e-6)).all()


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6))
def test_a_course_within_the_limits_is_sent_as_it_is_whatever_it_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    speed, course = np.zeros(6), [HOME]
    for push in rng.uniform(-1.0, 1.0, (10, 6)).repeat(40, axis=0):
        speed = np.clip(speed + push * ACCELERATION * DT_S, -VELOCITY, VELOCITY)
        course.append(course[-1] + speed * DT_S)
    assume(np.abs(course).max() < UPPER - 0.2)  # leaves space to brake before the joint limit
    joints, _ = driven(made_filter(), course[1:])
    np.testing.assert_allclose(joints, course, atol=1e-9)


def test_a_set_point_that_was_held_back_catches_up_with_a_course_that_slows_down_and_does_not_run_past() -> None:
    ahead = HOME + 0.2 + 0.1 * (1.0 - np.cos(np.linspace(0.0, np.pi, 400)))[:, None] * np.ones(6)
    joints, accelerations = driven(made_filter(), [*ahead, *itertools.repeat(ahead[-1], 300)])
    assert (joints[1:] - ahead[-1]).max() <= A_SHORT_LEAP_RAD
    np.testing.assert_allclose(joints[-1], ahead[-1], atol=1e-9)
    assert (np.abs(accelerations) <= ACCELERATION * (1.0 + 1e-6)).all()


def test_ticks_that_come_late_and_early_cost_a_steady_course_no_more_than_their_own_error() -> None:
    """A tenth of a period at up to 0.56 rad/s is 0.11 mrad; with a look-back of one tick only the error is 1 mrad."""
    rng = np.random.default_rng(3)
    u = np.clip((np.arange(1100) + rng.uniform(-0.1, 0.1, 1100)) * DT_S / 2.0, 0.0, 1.0)
    course = HOME + 0.6 * (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))[:, None] * np.ones(6)
    joints, _ = driven(made_filter(), course)
    error_rad = np.abs(joints[1:] - course)
    assert error_rad.max() <= 5e-4
    assert np.sqrt(np.mean(error_rad**2)) <= 1e-4


@pytest.mark.parametrize("leap", [-1.0, 1.0])
def test_a_brake_slows_every_joint_as_fast_as_it_may_whatever_was_wanted_last(leap: float) -> None:
    made = made_filter()
    driven(made, itertools.repeat(HOME + 1.0, 150))
    made.sent(made.apply(HOME + leap))
    while not made.is_at_rest:
        before = made.velocity_rad_per_s
        made.sent(made.brake())
        expected = np.maximum(before - ACCELERATION * DT_S, 0.0)
        np.testing.assert_allclose(made.velocity_rad_per_s, expected, atol=1e-9)


def test_at_the_speed_limit_of_the_tip_no_joint_brakes_harder_than_it_may() -> None:
    """If speeds were only scaled to the limit, fast wrists would be braked at seven times the allowed acceleration."""
    rng = np.random.default_rng(7)
    goals = HOME + np.repeat(rng.uniform(-0.6, 0.6, (50, 6)), 30, axis=0)
    _, accelerations = driven(made_filter(tip_limit_m_per_s=0.25), goals)
    assert np.quantile(np.abs(accelerations) / ACCELERATION, 0.999) <= 1.0 + 1e-6


@pytest.mark.parametrize("bad", [NAN, float("inf")])
def test_a_set_point_that_is_no_number_is_a_failure_of_the_controller(bad: float) -> None:
    wanted = HOME.copy()
    wanted[3] = bad
    with pytest.raises(DeviceFailure, match="not finite") as caught:
        made_filter().apply(wanted)
    assert caught.value.device == "controller"


SOFT = Compliance(stiffness=(500.0,) * 6, damping=(50.0,) * 6)
FELT = Guard(name="contact", quantity=Quantity.FORCE, limit=5.0)


@pytest.mark.parametrize(
    "motion", [replace(PATH, compliance=SOFT), replace(PATH, guards=(FELT,)), replace(HOLD, guards=(FELT,))]
)
def test_a_motion_into_contact_is_refused_where_no_sensor_measures_forces(motion: DeclaredMotion) -> None:
    check_is_felt(motion, has_force_torque=True)
    with pytest.raises(MotionRefused, match="nothing measures the force"):
        check_is_felt(motion, has_force_torque=False)


@pytest.mark.parametrize("motion", [TRAJECTORY, PATH, HOLD, GRASP])
def test_a_free_motion_needs_no_force_sensor(motion: DeclaredMotion) -> None:
    check_is_felt(motion, has_force_torque=False)
