from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from hal.devices import ArmCapabilities
from hal.errors import ConfigError, Unreachable
from hal.geometry import difference, interpolate, perturbed, transform_rpy
from manipulation.arm import kernels
from manipulation.arm.kinematics import Kinematics
from manipulation.control import braking
from manipulation.control import kernels as control_kernels
from tests.manipulation.arms import SEVEN, T3, UR, forward

ARMS = pytest.mark.parametrize("arm", [T3, UR], ids=lambda arm: arm.model)
TOOL = transform_rpy((0.01, -0.02, 0.15), (0.1, 0.2, -0.3))
vectors = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array)
joints = st.lists(st.floats(-2.8, 2.8), min_size=6, max_size=6).map(np.array)


@ARMS
@given(q=joints)
@settings(max_examples=30, deadline=None)
def test_the_compiled_chain_is_the_product_of_elementary_motions(arm: ArmCapabilities, q: np.ndarray) -> None:
    assert np.abs(Kinematics.of(arm).flange(q).as_matrix() - forward(arm, q)).max() < 1e-12


@ARMS
@given(q=joints)
@settings(max_examples=20, deadline=None)
def test_the_jacobian_is_the_derivative_of_the_tool_pose(arm: ArmCapabilities, q: np.ndarray) -> None:
    kinematics, h = Kinematics.of(arm), 1e-6
    columns = [
        difference(kinematics.tool(q + h * e, TOOL), kinematics.tool(q - h * e, TOOL)) / (2 * h) for e in np.eye(6)
    ]
    assert np.abs(kinematics.jacobian(q, TOOL) - np.array(columns).T).max() < 1e-7


@ARMS
def test_every_branch_of_the_inverse_reaches_the_pose_and_one_is_the_start(arm: ArmCapabilities) -> None:
    kinematics, rng = Kinematics.of(arm), np.random.default_rng(3)
    count = 100 if arm is T3 else 8  # two turns per joint give the second arm about 500 solution branches
    for q in rng.uniform(kinematics.lower_rad, kinematics.upper_rad, (count, 6)):
        pose = kinematics.flange(q)
        found = kinematics.inverse(pose)
        assert np.min(np.max(np.abs(found - q), axis=1)) < 1e-6
        assert np.all(found >= kinematics.lower_rad - 1e-9) and np.all(found <= kinematics.upper_rad + 1e-9)
        assert max(np.abs(forward(arm, f) - pose.as_matrix()).max() for f in found) < 1e-9


@pytest.mark.parametrize("arm", [T3, UR, SEVEN], ids=lambda arm: arm.model)
def test_a_pose_out_of_reach_has_no_inverse(arm: ArmCapabilities) -> None:
    assert len(Kinematics.of(arm).inverse(transform_rpy((2.0, 0.0, 0.5), (0.0, 0.0, 0.0)))) == 0


def test_an_arm_with_a_joint_to_spare_has_solutions_for_many_values_of_it() -> None:
    kinematics, rng = Kinematics.of(SEVEN), np.random.default_rng(4)
    for q in np.array([0.1, 0.5, 0.2, -1.6, 0.1, 1.9, 0.3]) + rng.uniform(-0.3, 0.3, (10, 7)):
        pose = kinematics.flange(q)
        found = kinematics.inverse(pose)
        assert len(np.unique(found[:, -1])) >= 3
        assert np.all(found >= kinematics.lower_rad - 1e-9) and np.all(found <= kinematics.upper_rad + 1e-9)
        assert max(np.abs(forward(SEVEN, f) - pose.as_matrix()).max() for f in found) < 1e-9


def test_an_arm_without_a_known_solution_is_refused_when_it_is_described() -> None:
    with pytest.raises(ConfigError, match="no closed inverse kinematics for its 5 joints"):
        Kinematics.of(replace(T3, links=T3.links[:5]))


def test_an_arm_with_a_joint_to_spare_follows_a_stroke_by_the_steps_that_the_executor_takes() -> None:
    kinematics = Kinematics.of(SEVEN)
    start = np.array([0.1, 0.5, 0.2, -1.6, 0.1, 1.9, 0.3])
    first = kinematics.flange(start)
    poses = [perturbed(first, np.array([0, 0.004 * k, -0.003 * k, 0, 0, 0.02 * k])) for k in range(30)]
    for path in kinematics.follow(poses, near_rad=start):
        q = path[0]
        for planned, before, after in zip(path[1:], poses, poses[1:], strict=False):
            for f in np.linspace(0.0, 1.0, 11)[1:]:
                q = kernels.follow_pose(kinematics.dh, np.eye(4), q, interpolate(before, after, f).as_matrix(), 1e-3, 2)
            assert np.abs(planned - q).max() < 2e-3
            assert np.abs(forward(SEVEN, planned) - after.as_matrix()).max() < 1e-6


def test_a_stroke_stays_on_one_branch_and_the_best_is_near() -> None:
    kinematics = Kinematics.of(T3)
    start = np.array([0.1, 0.3, 0.2, 0.1, 0.6, 0.0])
    first = kinematics.flange(start)
    poses = [perturbed(first, np.array([0, 0.004 * k, -0.003 * k, 0, 0, 0.02 * k])) for k in range(30)]
    best = kinematics.follow(poses, near_rad=start)[0]
    assert np.abs(best[0] - start).max() < 1e-6
    assert np.abs(np.diff(best, axis=0)).max() < 0.1
    for q, pose in zip(best, poses, strict=True):
        assert np.abs(forward(T3, q) - pose.as_matrix()).max() < 1e-6


@pytest.mark.parametrize("turns", [(0, 0), (1, -1)])
def test_whole_turns_of_a_path_are_paths_of_their_own_and_the_nearest_is_best(turns: tuple[int, int]) -> None:
    kinematics = Kinematics.of(UR)
    start = np.array([0.1, -1.2, 1.4, -1.1, -1.5, 0.3])
    poses = [perturbed(kinematics.flange(start), np.array([0, 0.002 * k, 0, 0, 0, 0.01 * k])) for k in range(10)]
    near = start + 2.0 * np.pi * np.array([0, turns[0], 0, 0, 0, turns[1]])
    paths = kinematics.follow(poses, near_rad=near)
    assert np.abs(paths[0][0] - near).max() < 1e-6
    alike = [
        p for p in paths if np.allclose(np.cos(p[0] - start), 1.0) and np.allclose(np.diff(p - paths[0], axis=0), 0)
    ]
    assert len(np.unique(np.round([p[0] for p in alike], 6), axis=0)) == len(alike) > 1
    expected = np.prod(
        [
            sum(low <= first + 2.0 * np.pi * k <= high for k in range(-3, 4))
            for first, low, high in zip(start, kinematics.lower_rad, kinematics.upper_rad, strict=True)
        ]
    )
    assert len(alike) == expected
    assert min(np.min([p - kinematics.lower_rad, kinematics.upper_rad - p]) for p in paths) >= -1e-9


def test_a_stroke_out_of_the_workspace_is_unreachable_and_says_where() -> None:
    kinematics = Kinematics.of(T3)
    first = kinematics.flange(np.array([0.1, 0.3, 0.2, 0.1, 0.6, 0.0]))
    poses = [perturbed(first, np.array([0.02 * k, 0, 0, 0, 0, 0])) for k in range(60)]
    with pytest.raises(Unreachable, match="pose"):
        kinematics.follow(poses, near_rad=np.zeros(6))


@given(w=vectors)
@settings(max_examples=60, deadline=None)
def test_rotation_exp_and_log_agree_with_scipy(w: np.ndarray) -> None:
    matrix = Rotation.from_rotvec(w).as_matrix()
    assert np.abs(kernels.rotation_exp(w) - matrix).max() < 1e-12
    assert np.abs(kernels.rotation_log(matrix) - w).max() < 1e-7


@given(a=vectors, b=vectors, f=st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_a_path_is_interpolated_as_the_house_interpolates(a: np.ndarray, b: np.ndarray, f: float) -> None:
    start = RigidTransform.from_components(a, Rotation.from_rotvec(a))
    end = RigidTransform.from_components(b, Rotation.from_rotvec(b))
    turn = (end.rotation * start.rotation.inv()).as_rotvec()
    points, rotations = np.array([a, b]), np.array([start.rotation.as_matrix(), end.rotation.as_matrix()])
    times, ways = np.array([1.0, 3.0]), np.array([0.0, 1.0])
    rates, speeds = np.array([[(b - a) / 2.0]] * 2), np.array([0.5, 0.5])
    pose = control_kernels.pose_on_path(times, ways, speeds, points, rates, rotations, turn[None], 1.0 + 2.0 * f)
    assert np.abs(pose - interpolate(start, end, f).as_matrix()).max() < 1e-9


def test_following_a_pose_converges_on_it() -> None:
    kinematics = Kinematics.of(T3)
    q = np.array([0.1, 0.3, 0.2, 0.1, 0.6, 0.0])
    goal = perturbed(kinematics.tool(q, TOOL), np.array([0.002, -0.001, 0.001, 0.01, 0.0, -0.01]))
    found = kernels.follow_pose(kinematics.dh, TOOL.as_matrix(), q, goal.as_matrix(), 1e-4, 4)
    assert np.linalg.norm(difference(goal, kinematics.tool(found, TOOL))) < 1e-8


@given(f=vectors, t=vectors, d=vectors, r=vectors)
@settings(max_examples=40, deadline=None)
def test_a_wrench_does_the_same_work_in_either_frame(
    f: np.ndarray, t: np.ndarray, d: np.ndarray, r: np.ndarray
) -> None:
    parent_from_child = RigidTransform.from_components(d, Rotation.from_rotvec(r))
    seen = control_kernels.wrench_at(np.concatenate([f, t]), parent_from_child.inv().as_matrix())
    # Virtual work of a rigid motion (v, w) of the body, expressed at the parent's origin and at the child's.
    for v, w in ((np.array([1.0, 2.0, -1.0]), np.array([0.3, -0.2, 0.5])), (np.zeros(3), np.array([1.0, 0.0, 2.0]))):
        at_child = v + np.cross(w, d)
        inverse = parent_from_child.rotation.inv()
        work = seen[:3] @ inverse.apply(at_child) + seen[3:] @ inverse.apply(w)
        assert abs(work - (f @ v + t @ w)) < 1e-9


def test_admittance_settles_at_force_over_stiffness_and_rigid_axes_stay() -> None:
    state = np.zeros((2, 6))
    stiffness = np.array([500.0, np.inf, 0.0, 10.0, np.inf, np.inf])
    damping, mass = np.full(6, 400.0), np.full(6, 20.0)
    wrench = np.array([5.0, 50.0, 4.0, 0.1, 1.0, 1.0])
    bound = np.array([0.05, 0.05, 0.05, 0.3, 0.3, 0.3])
    for _ in range(20000):
        control_kernels.admittance_step(state, wrench, stiffness, damping, mass, bound, 0.002)
    assert state[0, 0] == pytest.approx(0.01, rel=1e-3)
    assert state[0, 1] == 0.0
    assert state[0, 2] == 0.05  # an axis without stiffness drifts to its bound and stays there


@given(speed=st.floats(0.0, 50.0))
def test_the_way_to_rest_is_that_of_a_brake_tick_by_tick(speed: float) -> None:
    left, way = speed - 1.0, 0.0
    while left > 0.0:
        way, left = way + left, left - 1.0
    assert braking.rest_way(speed, 1.0) == pytest.approx(way, abs=1e-9)
    assert braking.fastest_to_rest(speed + way, 1.0) == pytest.approx(speed, abs=1e-9)


def test_a_set_point_never_breaks_range_speed_or_acceleration_limits() -> None:
    rng = np.random.default_rng(5)
    velocity, acceleration, dt = np.full(3, 1.0), np.full(3, 10.0), 0.002
    q, v, before, end = np.zeros(3), np.zeros(3), np.zeros(3), np.full(3, 0.05)
    for _ in range(2000):
        wanted = q + rng.normal(0, 0.1, 3)
        new = braking.limited_step(wanted, before[None], q, v, velocity, acceleration, -end, end, dt)
        now, before = (new - q) / dt, wanted
        assert np.all(np.abs(new) <= end + 1e-12)
        assert np.all(np.abs(now) <= velocity + 1e-9)
        assert np.all(np.abs(now - v) <= acceleration * dt + 1e-9)
        q, v = new, now
