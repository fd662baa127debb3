"""Compares the propagation of covariances with finite differences and sampling."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from hal.geometry import (
    UncertainPose,
    certain,
    compose,
    difference,
    from_json,
    interpolate,
    perturbed,
    point_covariance,
    product,
    skew,
    to_json,
    transform_rpy,
)

numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.map(lambda v: 0.85 * v)  # less than half a turn, beyond which rotation vectors are not unique
poses = st.builds(lambda t, r: RigidTransform.from_components(t, Rotation.from_rotvec(r)), vectors, vectors)


def random_covariance(seed: int) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(6, 6)) * 1e-3
    return a @ a.T


def numeric_jacobian(function, step=1e-6) -> np.ndarray:
    at = np.zeros(6)
    return np.column_stack([(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(6)])


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(poses, vectors, turns)
def test_difference_undoes_perturbed(pose: RigidTransform, d: np.ndarray, r: np.ndarray) -> None:
    delta = np.concatenate([d, r])
    np.testing.assert_allclose(difference(perturbed(pose, delta), pose), delta, atol=1e-7)


@given(poses, poses)
@settings(max_examples=30)
def test_chained_covariance_matches_finite_differences(a: RigidTransform, b: RigidTransform) -> None:
    ca, cb = random_covariance(1), random_covariance(2)
    chained = compose(
        UncertainPose(parent_from_child=a, covariance=ca), UncertainPose(parent_from_child=b, covariance=cb)
    )
    ja = numeric_jacobian(lambda x: difference(perturbed(a, x) * b, a * b))
    jb = numeric_jacobian(lambda x: difference(a * perturbed(b, x), a * b))
    np.testing.assert_allclose(chained.covariance, ja @ ca @ ja.T + jb @ cb @ jb.T, atol=1e-11)


@given(poses)
@settings(max_examples=30)
def test_inverse_covariance_matches_finite_differences(a: RigidTransform) -> None:
    c = random_covariance(3)
    inverse = UncertainPose(parent_from_child=a, covariance=c).inverse()
    j = numeric_jacobian(lambda x: difference(perturbed(a, x).inv(), a.inv()))
    np.testing.assert_allclose(inverse.covariance, j @ c @ j.T, atol=1e-11)


@given(poses, vectors)
@settings(max_examples=30)
def test_point_covariance_matches_finite_differences(a: RigidTransform, p: np.ndarray) -> None:
    c = random_covariance(4)
    j = numeric_jacobian(lambda x: perturbed(a, x).apply(p) - a.apply(p))
    np.testing.assert_allclose(
        point_covariance(UncertainPose(parent_from_child=a, covariance=c), p), j @ c @ j.T, atol=1e-11
    )


@given(poses, poses)
def test_interpolation_begins_and_ends_at_its_ends(a: RigidTransform, b: RigidTransform) -> None:
    np.testing.assert_allclose(interpolate(a, b, 0.0).as_matrix(), a.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(interpolate(a, b, 1.0).as_matrix(), b.as_matrix(), atol=1e-7)


@given(poses)
def test_json_keeps_a_pose(a: RigidTransform) -> None:
    np.testing.assert_allclose(from_json(to_json(a)).as_matrix(), a.as_matrix(), atol=1e-12)


def test_a_certain_pose_adds_nothing() -> None:
    c = random_covariance(5)
    uncertain = UncertainPose(parent_from_child=RigidTransform.identity(), covariance=c)
    np.testing.assert_allclose((certain(RigidTransform.identity()) * uncertain).covariance, c)


def test_roll_pitch_and_yaw_turn_about_the_parents_axes_in_that_order() -> None:
    roll, pitch, yaw = 0.3, -0.5, 1.1
    x, y, z = np.eye(3)
    expected = Rotation.from_rotvec(yaw * z) * Rotation.from_rotvec(pitch * y) * Rotation.from_rotvec(roll * x)
    pose = transform_rpy((1.0, 2.0, 3.0), (roll, pitch, yaw))
    np.testing.assert_allclose(pose.rotation.as_matrix(), expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(pose.translation, (1.0, 2.0, 3.0))


@given(poses, poses)
def test_a_product_without_normalising_is_the_product(a: RigidTransform, b: RigidTransform) -> None:
    np.testing.assert_allclose(product(a, b).as_matrix(), (a * b).as_matrix(), atol=1e-12)
