"""Tests of the proof that no other pose fits better: the quadratic form, its multipliers, and the certificates."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fusion_reference import residual
from benchmarks.fusion_simulation import CODES, Problem, problem
from fusion import fuse
from fusion.batch import pack
from fusion.certify import certificate
from fusion.certify.dual import minimiser, seen_from
from fusion.certify.proof import quadratic_forms
from fusion.certify.relaxation import constraints, relaxed
from fusion.robust import used_entries
from fusion.solve import solve
from hal.geometry import UncertainPose, difference, matrix_of, perturbed
from tests.fusion.mixtures import mixture


def test_every_pose_obeys_the_constraints() -> None:
    A, right = constraints()
    rng = np.random.default_rng(0)
    for _ in range(5):
        pose = mixture(1, int(rng.integers(1000))).base_from_object
        R, t = matrix_of(pose), np.array(pose.translation)
        z = np.concatenate([[1.0], R.ravel(), t, -R.T @ t])
        assert np.einsum("i,kij,j->k", z, A, z) == pytest.approx(right, abs=1e-12)


def lifted(p: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the problem's quadratic form, with directions fixed at the true pose, and that pose."""
    R, t = matrix_of(p.base_from_object), np.array(p.base_from_object.translation)
    return quadratic_forms(pack(p.measurements), R, t, np.zeros(3), np.zeros(3), 1.0), R, t


def monomials(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.concatenate([[1.0], R.ravel(), t, -R.T @ t])


def test_the_quadratic_form_is_the_squared_rows_of_every_class() -> None:
    p = problem(CODES, np.random.default_rng(1))
    forms, R, t = lifted(p)
    z = monomials(R, t)
    expected = [residual(m, R, t) @ residual(m, R, t) for m in p.measurements]
    assert np.einsum("i,kij,j->k", z, forms, z) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_the_quadratic_form_of_a_prior_is_its_whitened_difference() -> None:
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 6)) * 1e-3
    prior = UncertainPose(parent_from_child=mixture(1, 6).base_from_object, covariance=A @ A.T + 1e-8 * np.eye(6))
    delta = 1e-3 * rng.normal(size=6)
    pose = perturbed(prior.parent_from_child, delta)
    R, t = matrix_of(pose), np.array(pose.translation)
    form = quadratic_forms(pack([], prior), R, t, np.zeros(3), np.zeros(3), 1.0)[0]
    z = monomials(R, t)
    assert z @ form @ z == pytest.approx(delta @ np.linalg.solve(prior.covariance, delta), rel=1e-3)


def test_composed_poses_are_one_linear_map() -> None:
    first, second = mixture(1, 1).base_from_object, mixture(1, 2).base_from_object
    both = first * second
    T = seen_from(matrix_of(first), np.array(first.translation))
    z = monomials(matrix_of(second), np.array(second.translation))
    assert T @ z == pytest.approx(monomials(matrix_of(both), np.array(both.translation)), abs=1e-12)


def test_multipliers_and_the_solver_give_the_same_bound() -> None:
    pytest.importorskip("clarabel", reason="the certificate is an extra")
    for seed in range(4):
        forms, R, t = lifted(mixture(16, 30 + seed))
        Q = forms.sum(axis=0)
        found = minimiser(Q, R, t)
        assert found.proven
        assert relaxed(Q)[1] == pytest.approx(found.value, rel=0.02, abs=0.05)


def test_a_minimum_that_is_only_local_has_no_multipliers() -> None:
    found = []
    for seed in range(6):
        forms, R, t = lifted(mixture(7, 40 + seed))
        Q = forms.sum(axis=0)
        best = minimiser(Q, R, t)
        for axis in np.eye(3):
            other = minimiser(Q, R @ (2 * np.outer(axis, axis) - np.eye(3)), t)
            if other.value > best.value * (1 + 1e-6) + 1e-6:
                found.append(other)
    assert found
    assert not any(other.proven for other in found)


def test_the_answer_without_mismatches_is_certified() -> None:
    pytest.importorskip("clarabel", reason="the certificate is an extra")
    p = mixture(16, 3)
    answer = fuse(p.measurements, certify=True)
    proof = answer.certificate
    assert proof is not None
    assert proof.tight
    assert proof.gap < 1e-3
    assert proof.value == pytest.approx(answer.chi_square, rel=0.02)
    assert proof.lower_bound <= proof.value + 0.1
    assert np.abs(difference(answer.pose, proof.base_from_object)).max() < 1e-3


def test_a_pose_that_is_not_the_best_is_not_certified() -> None:
    pytest.importorskip("clarabel", reason="the certificate is an extra")
    p = mixture(16, 4)
    answer = fuse(p.measurements)
    b, used, local = used_entries(p.measurements, answer)
    wrong = solve(p.measurements[:4], answer.pose)
    moved = type(local)(
        rotation=matrix_of(answer.pose), translation_m=answer.pose.translation + 0.01, covariance=local.covariance,
        information=local.information, values=local.values, chi_square=0.0, dof=1, unobservable=wrong.unobservable,
    )  # fmt: skip
    assert not certificate(b, used, moved).tight
