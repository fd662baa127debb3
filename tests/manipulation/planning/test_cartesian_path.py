from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.geometry import difference, transform_rpy
from manipulation.control.executors import smooth_ways
from manipulation.planning.cartesian_path import RAMP_M_PER_S2, RISE_S, arc, line, ramped, shifted, through

START = transform_rpy((0.5, 0.1, 0.6), (0.1, -0.2, 0.3))
TOOL = transform_rpy((0.0, 0.0, 0.2), (0.0, 0.0, 0.0))


@given(way=st.floats(0.001, 0.5), speed=st.floats(0.01, 0.25))
@settings(max_examples=50, deadline=None)
def test_a_ramped_move_ends_in_place_and_keeps_speed_and_ramp(way: float, speed: float) -> None:
    t, s = ramped(way, speed, ramp_m_per_s2=0.5)
    v = np.diff(s) / np.diff(t)
    assert s[0] == 0.0 and s[-1] == pytest.approx(way)
    assert np.all(v >= -1e-9) and np.all(v <= speed * 1.01)
    assert v[0] <= 0.5 * t[1] and v[-1] <= 0.5 * (t[-1] - t[-2]) + 1e-3
    # From rest to rest with ramps, it is never faster than the exact trapezoid or triangle.
    exact = way / speed + speed / 0.5 if way > speed**2 / 0.5 else 2 * np.sqrt(way / 0.5)
    assert t[-1] == pytest.approx(exact + RISE_S, rel=0.02, abs=0.004)
    assert np.abs(np.diff(v, 2)).max() <= 0.5 / RISE_S * t[1] ** 2 * 2.1, "the acceleration changes within the rise"


def test_a_slow_end_is_slow() -> None:
    t, s = ramped(0.2, 0.1, slow_last_m=0.05, slow_ratio=0.3)
    v = np.diff(s) / np.diff(t)
    late = s[:-1] > 0.155
    assert v[late].max() <= 0.031
    assert v[~late].max() > 0.095


def test_no_way_is_no_move() -> None:
    motion = line(START, START, name="none", speed_m_per_s=0.1, flange_from_tool=TOOL)
    assert all(np.linalg.norm(difference(pose, START)) < 1e-12 for pose in motion.base_from_tool)
    assert np.all(np.diff(motion.times_s) > 0)


def test_a_line_is_straight_in_its_own_axes() -> None:
    motion = line(START, shifted(START, (0.0, 0.0, 0.05)), name="down", speed_m_per_s=0.06, flange_from_tool=TOOL)
    local = np.array([(START.inv() * pose).translation for pose in motion.base_from_tool])
    assert np.abs(local[:, :2]).max() < 1e-12
    assert local[-1, 2] == pytest.approx(0.05)


@given(angle=st.floats(-2.5, 2.5).filter(lambda a: abs(a) > 0.05))
@settings(max_examples=30, deadline=None)
def test_an_arc_keeps_its_distance_and_turns_with_the_radius(angle: float) -> None:
    centre, axis = np.array([0.55, 0.12, 0.61]), np.array([-1.0, 0.2, 0.1])
    unit = axis / np.linalg.norm(axis)
    poses = arc(START, centre_m=centre, axis=axis, angle_rad=angle)
    radii = [np.linalg.norm(np.cross(pose.translation - centre, unit)) for pose in poses]
    assert np.ptp(radii) < 1e-12
    # A point on the rotation axis does not move in tool axes, because the tool rotates rigidly about it.
    local = np.array([pose.inv().apply(centre) for pose in poses])
    assert np.ptp(local, axis=0).max() < 1e-12
    assert (poses[-1].rotation * START.rotation.inv()).as_rotvec() @ unit == pytest.approx(angle)


def test_a_path_through_poses_visits_them_in_order() -> None:
    poses = arc(START, centre_m=(0.5, 0.0, 0.6), axis=(1.0, 0.0, 0.0), angle_rad=1.0)
    motion = through(poses, name="round", speed_m_per_s=0.08, flange_from_tool=TOOL)
    way = np.array([pose.translation for pose in motion.base_from_tool])
    for pose in poses[:: len(poses) // 4]:
        assert np.linalg.norm(way - pose.translation, axis=1).min() < 2e-3
    assert np.linalg.norm(difference(motion.base_from_tool[-1], poses[-1])) < 1e-9


def test_the_executor_smooths_the_speed_between_samples() -> None:
    t, s = ramped(0.1, 0.06)
    points = np.column_stack([s, np.zeros_like(s), np.zeros_like(s)])
    ways, speeds = smooth_ways(t, points, np.zeros((len(t) - 1, 3)))
    assert speeds[0] == speeds[-1] == 0.0
    assert ways[-1] == pytest.approx(0.1)
    rates = np.diff(ways) / np.diff(t)
    for speed, (before, after) in zip(speeds[1:-1], itertools.pairwise(rates), strict=True):
        assert 0.0 <= speed <= 3.0 * min(before, after) + 1e-12, "a cubic within these bounds does not run backwards"
    assert np.abs(np.diff(speeds, 2)).max() <= 1.1 * RAMP_M_PER_S2 / RISE_S * t[1] ** 2
