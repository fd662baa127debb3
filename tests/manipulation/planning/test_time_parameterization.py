"""Tests of transfers in time: every tick of any path is within the limits, and little time is lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.devices import ArmCapabilities
from hal.geometry import transform_rpy
from hal.motion import JointTrajectory
from manipulation.arm.kinematics import Kinematics
from manipulation.control import kernels as control_kernels
from manipulation.control.setpoint import SetPointLimiter, flange_matrix
from manipulation.planning import timing_kernels
from manipulation.planning.smooth_path import SmoothPath
from manipulation.planning.time_parameterization import SpeedLimits, timed
from tests.manipulation.arms import SEVEN, T3, UR

TOOL = transform_rpy((0.0, 0.0, 0.2), (0.0, 0.0, 0.0))
DT_S = 0.002
ROUNDING = 1.005
TIPS = (0.1, 0.25, 1.0)


def random_path(arm: Kinematics, rng: np.random.Generator) -> SmoothPath:
    """Return a path of up to five legs with corners of any width, as a search among obstacles leaves them."""
    low, high = 0.9 * arm.lower_rad, 0.9 * arm.upper_rad
    points = [rng.uniform(0.5 * low, 0.5 * high)]
    for _ in range(rng.integers(1, 6)):
        points.append(np.clip(points[-1] + rng.normal(0.0, rng.choice([0.02, 0.2, 0.6]), len(low)), low, high))
    path = SmoothPath.of(np.array(points))
    return SmoothPath.of(path.points_rad, path.reaches_rad * 0.5 ** rng.integers(0, 6, len(path.reaches_rad)))


def ticks(motion: JointTrajectory) -> np.ndarray:
    """Return the set-points (M, n) of every tick, with rest before and behind."""
    times = np.arange(0.0, motion.times_s[-1] + DT_S, DT_S)
    sent = [
        control_kernels.hermite(motion.times_s, motion.positions_rad, motion.velocities_rad_per_s, t) for t in times
    ]
    return np.array([sent[0]] * 3 + sent + [sent[-1]] * 3)


@pytest.mark.parametrize("caps", [T3, UR, SEVEN], ids=lambda caps: caps.model)
@given(seed=st.integers(0, 10**6), tip=st.sampled_from(TIPS))
@settings(max_examples=25, deadline=None)
def test_every_tick_of_any_path_keeps_speed_acceleration_jerk_and_the_speed_of_the_tip(
    caps: ArmCapabilities, seed: int, tip: float
) -> None:
    arm, limits = Kinematics.of(caps), SpeedLimits(tip_m_per_s=tip)
    path = random_path(arm, np.random.default_rng(seed))
    motion = timed(arm, path, flange_from_tool=TOOL, limits=limits, name="any")
    sent = ticks(motion)
    speed, acceleration, _ = limits.of_joints(arm)
    assert (np.abs(np.diff(sent, axis=0)) / DT_S <= ROUNDING * speed).all()
    assert (np.abs(np.diff(sent, 2, axis=0)) / DT_S**2 <= ROUNDING * acceleration).all()
    assert (np.abs(np.diff(sent, 3, axis=0)) / DT_S**3 <= arm.jerk_rad_per_s3).all()
    tips = np.array([(arm.flange(q).as_matrix() @ TOOL.as_matrix())[:3, 3] for q in sent[::5]])
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() <= ROUNDING * tip * 5 * DT_S
    np.testing.assert_allclose(sent[0], path.points_rad[0], atol=1e-12)
    np.testing.assert_allclose(sent[-1], path.points_rad[-1], atol=1e-12)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_the_last_filter_sends_a_transfer_as_it_was_planned(seed: int) -> None:
    """The set-point trailed by 0.49 rad where rounded corners asked for 3.4 times the arm's acceleration."""
    arm = Kinematics.of(T3)
    path = random_path(arm, np.random.default_rng(seed))
    motion = timed(arm, path, flange_from_tool=TOOL, limits=SpeedLimits(tip_m_per_s=0.25), name="any")
    made = SetPointLimiter(arm, flange_matrix(TOOL), 0.26, DT_S)
    made.begin_at(path.points_rad[0])
    trail = 0.0
    for wanted in ticks(motion):
        made.sent(made.apply(wanted))
        trail = max(trail, float(np.abs(made.last_rad - wanted).max()))
    assert trail < 1e-6


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_a_transfer_lasts_hardly_longer_than_without_a_limit_of_the_jerk(seed: int) -> None:
    arm, limits = Kinematics.of(T3), SpeedLimits(tip_m_per_s=0.25)
    path = random_path(arm, np.random.default_rng(seed))
    motion = timed(arm, path, flange_from_tool=TOOL, limits=limits, name="any")
    grid, step = np.linspace(0.0, path.length_rad, 800, retstep=True)
    geometry, most = path.at(grid), limits.of_joints(arm)
    tip = timing_kernels.tip_ways(arm.dh, geometry, flange_matrix(TOOL))
    ceiling = np.minimum(np.min(most[0] / (np.abs(geometry[1]) + 1e-9), axis=1), 0.25 / (tip + 1e-9)) ** 2
    speed = np.sqrt(timing_kernels.squared_speeds(geometry, float(step), ceiling, most[1]))
    fastest_s = float(np.sum(2.0 * step / (speed[1:] + speed[:-1])))
    legs = len(path.points_rad) - 1
    assert fastest_s < motion.times_s[-1] < 1.06 * fastest_s + 0.12 * legs


def test_a_straight_transfer_is_that_of_the_closed_solution() -> None:
    """One joint from rest to rest over 1 rad: the fastest motion lasts L/v + v/a + a/j."""
    arm, limits = Kinematics.of(T3), SpeedLimits(tip_m_per_s=100.0)
    start = np.array([0.0, 0.5, 0.3, 0.0, 0.5, 0.0])
    motion = timed(
        arm, SmoothPath.of(np.array([start, start + np.eye(6)[0]])), flange_from_tool=TOOL, limits=limits, name="one"
    )
    v, a, j = limits.of_joints(arm)[:, 0]
    assert motion.times_s[-1] == pytest.approx(1.0 / v + v / a + a / j, abs=0.01)


def test_a_transfer_to_where_the_arm_is_takes_no_time() -> None:
    here = np.array([0.1, 0.5, 0.3, 0.0, 0.5, 0.0])
    motion = timed(
        Kinematics.of(T3), SmoothPath.of(np.array([here, here])), flange_from_tool=TOOL,
        limits=SpeedLimits(tip_m_per_s=0.25), name="none",
    )  # fmt: skip
    assert motion.times_s[-1] <= DT_S
    np.testing.assert_array_equal(motion.positions_rad, [here, here])


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_the_derivatives_of_a_smooth_path_are_those_of_its_joints(seed: int) -> None:
    path = random_path(Kinematics.of(T3), np.random.default_rng(seed))
    h = 1e-4 * path.length_rad
    at = np.linspace(2 * h, path.length_rad - 2 * h, 97)
    before, here, after = path.at(at - h), path.at(at), path.at(at + h)
    for order in range(3):
        slope = (after[order] - before[order]) / (2 * h)
        scale = np.abs(here[order + 1]).max() + 1.0
        assert np.median(np.abs(slope - here[order + 1])) <= 1e-3 * scale


def test_rounded_corners_keep_the_ends_and_stay_near() -> None:
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    path = SmoothPath.of(corner, np.array([0.0, 0.2, 0.0]))
    dense = path.at(np.linspace(0.0, path.length_rad, 401))[0]
    assert np.array_equal(dense[0], corner[0]) and np.allclose(dense[-1], corner[-1])
    nearest = np.linalg.norm(dense - corner[1], axis=1).min()
    assert nearest == pytest.approx(0.2 * np.sqrt(2) * (0.25 - 1.0 / np.pi**2), rel=1e-3)


def test_points_of_a_path_that_coincide_count_once() -> None:
    path = SmoothPath.of(np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]))
    np.testing.assert_array_equal(path.points_rad, [[0.0, 0.0], [1.0, 0.0]])
