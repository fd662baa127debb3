"""Compares the compiled residuals with the table of residuals in numpy, for any matrices and any pose."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fusion_reference import residual
from fusion.batch import pack
from fusion.distance.rows import FAR, NEAR, values, whitened
from fusion.measurement import SensingClass
from hal.geometry import UncertainPose, difference, matrix_of, perturbed
from tests.fusion.distance.test_distance import CLASSES, random_measurement, random_pose


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.words)
def test_the_compiled_rows_are_those_of_the_table(cls: SensingClass) -> None:
    rng = np.random.default_rng(10 + int(cls))
    given, pose = [random_measurement(cls, rng) for _ in range(20)], random_pose(rng)
    R, t = matrix_of(pose), np.array(pose.translation)
    expected = [residual(m, R, t) @ residual(m, R, t) for m in given]
    found = np.empty(len(given))
    values(pack(given), R, t, NEAR, found)
    assert found == pytest.approx(expected, rel=1e-3)  # the direction's variance has a floor of 1e-6 of it


@pytest.mark.parametrize("far", [NEAR, FAR])
def test_a_prior_is_the_whitened_difference_of_the_poses(far: bool) -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6)) * 1e-3
    prior = UncertainPose(parent_from_child=random_pose(rng), covariance=A @ A.T + 1e-8 * np.eye(6))
    pose = perturbed(prior.parent_from_child, 1e-3 * rng.normal(size=6))
    r, J, V = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    b, R, t = pack([], prior), matrix_of(pose), np.array(pose.translation)
    assert whitened(b, 0, R, t, far, r, J, V) == 6
    delta = difference(pose, prior.parent_from_child)
    assert r @ r == pytest.approx(delta @ np.linalg.solve(prior.covariance, delta), rel=1e-6)
    information = J.T @ J
    assert information == pytest.approx(np.linalg.inv(prior.covariance), rel=1e-6)
