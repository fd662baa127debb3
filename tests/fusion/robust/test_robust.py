"""Tests of `fuse`: right pose, consistent covariance, mismatches named, mirror poses and prior reported."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.fusion_simulation import CODES, TABLE_II, Problem, problem
from fusion import fuse
from fusion.features import Kind, point
from fusion.measurement import measurement
from fusion.robust import used_entries
from fusion.robust.evidence import log_evidence
from fusion.solve import solve, solve_from_many
from hal.geometry import UncertainPose, difference, perturbed, transform
from tests.fusion.mixtures import mixture


def is_near(p: Problem, pose: transform) -> bool:
    delta = difference(p.base_from_object, pose)
    return bool(np.linalg.norm(delta[:3]) < 0.005 and np.linalg.norm(delta[3:]) < np.radians(1))


@pytest.mark.parametrize(("count", "bad"), [(16, 1), (16, 4), (16, 8), (24, 12)])
def test_mismatches_are_found_and_named(count: int, bad: int) -> None:
    for seed in range(3):
        p = mixture(count, 100 + seed, bad)
        answer = fuse(p.measurements)
        if 2 * bad < count:
            assert is_near(p, answer.pose)
            assert p.bad <= {r.index for r in answer.rejected}
            assert len(answer.rejected) <= bad + 1
        # If half of them are wrong, as many may agree on another pose by chance; then the right one is listed, too.
        assert is_near(p, answer.pose) or any(is_near(p, a.pose) for a in answer.alternatives)
        assert all(r.value > r.limit and r.reason == "mismatch" for r in answer.rejected)


def test_least_squares_fails_where_the_robust_answer_does_not() -> None:
    p = problem(TABLE_II, np.random.default_rng(1), bad=[0])
    assert not is_near(p, solve_from_many(p.measurements, starts=16).base_from_object)
    assert is_near(p, fuse(p.measurements).pose)


def test_table_two_names_the_bad_one_from_the_fifth_measurement_on() -> None:
    p = problem(TABLE_II, np.random.default_rng(2), bad=[0])
    for n in (5, 8, 12, 16):
        assert [r.index for r in fuse(p.measurements[:n]).rejected] == [0]


def test_covariance_is_honest() -> None:
    nees = []
    for seed in range(60):
        p = mixture(14, 200 + seed)
        answer = fuse(p.measurements)
        delta = difference(p.base_from_object, answer.pose)
        nees.append(delta @ np.linalg.solve(answer.covariance, delta))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(nees))
    assert low < sum(nees) < high


@pytest.mark.parametrize("seed", [74, 140, 153, 198, 199, 216, 223])
def test_no_good_measurement_is_given_up_for_a_worse_sum(seed: int) -> None:
    """With elongated covariances all measurements agree near the truth, but a set without one has a minimum nearby."""
    rng = np.random.default_rng(seed)
    p = problem([CODES[k] for k in rng.integers(len(CODES), size=12)], rng, anisotropy=100.0)
    believing_all = solve(p.measurements, p.base_from_object)
    answer = fuse(p.measurements)
    assert not answer.rejected
    assert answer.chi_square <= believing_all.chi_square + 1e-6


def test_the_same_input_gives_the_same_answer() -> None:
    p = mixture(16, 5, 4)
    a, b = fuse(p.measurements), fuse(p.measurements)
    assert np.array_equal(a.pose.as_matrix(), b.pose.as_matrix())


def test_order_does_not_matter() -> None:
    p = mixture(16, 6, 3)
    a, b = fuse(p.measurements), fuse(p.measurements[::-1])
    assert np.abs(difference(a.pose, b.pose)).max() < 1e-7
    assert {r.index for r in a.rejected} == {15 - r.index for r in b.rejected}


def test_points_on_a_line_of_symmetry_leave_a_mirror() -> None:
    """Two stereo points and a plane through both also fit the pose flipped about the line through the points."""
    pose = transform(np.eye(3), (0.5, 0.1, 0.3))
    C = 0.0005**2 * np.eye(3)
    features = [point((0, 0, 0)), point((0.4, 0, 0)), point((0.1, 0.2, 0.0))]
    given = [measurement(f, Kind.POINT, mu_m=pose.apply(f.point_m), C_m2=C) for f in features[:2]]
    # Of the third point only the plane y = const is known, so positions above and below the line both fit.
    M = 1e6 * (np.eye(3) - np.diag([0.0, 1.0, 0.0]))
    off = point((0.1, 0.2, 0.1))
    given.append(measurement(off, Kind.PLANE, mu_m=pose.apply(off.point_m), C_m2=C, M=M))
    answer = fuse(given)
    assert answer.is_ambiguous
    poses = [answer.pose, *(a.pose for a in answer.alternatives)]
    assert min(np.abs(difference(pose, found)).max() for found in poses) < 0.01
    assert answer.alternatives[0].odds > 0.3


@pytest.mark.parametrize("seed", [1, 24, 29, 45])
def test_three_rays_of_one_camera_fit_up_to_four_poses_and_the_true_one_is_listed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = transform(Rotation.random(rng=rng).as_matrix(), (0.5, 0.1, 0.3))
    marks = [point((-0.3, -0.2, 0.0)), point((0.3, -0.2, 0.0)), point((0.1, 0.25, 0.0))]
    eye = pose.apply(rng.normal(0, (0.4, 0.4, 0.1)) + np.array([0.0, 0.0, 1.0]))
    given = []
    for mark in marks:
        ray = pose.apply(mark.point_m) - eye
        M = 3e6 * (np.eye(3) - np.outer(ray, ray) / (ray @ ray))
        given.append(measurement(mark, Kind.LINE, mu_m=eye, C_m2=9e-8 * np.eye(3), M=M))
    answer = fuse(given)
    found = [answer.pose, *(other.pose for other in answer.alternatives)]
    assert min(np.abs(difference(pose, one)).max() for one in found) < 1e-3


def test_a_prior_sharpens_and_a_wrong_prior_is_outvoted() -> None:
    p = mixture(10, 8)
    sigma = np.array([2e-4] * 3 + [2e-4] * 3)
    right = UncertainPose(parent_from_child=p.base_from_object, covariance=np.diag(sigma**2))
    without, sharpened = fuse(p.measurements), fuse(p.measurements, prior=right)
    assert np.trace(sharpened.covariance) < np.trace(without.covariance)
    wrong = UncertainPose(
        parent_from_child=perturbed(p.base_from_object, np.array([0.1, 0, 0, 0, 0.2, 0])), covariance=np.diag(sigma**2)
    )
    answer = fuse(p.measurements, prior=wrong)
    assert [r.index for r in answer.rejected] == [-1]
    assert answer.rejected[0].label == "prior pose"
    assert is_near(p, answer.pose)


def test_a_prior_alone_is_the_answer() -> None:
    pose = transform(np.eye(3), (0.3, 0.2, 0.1))
    answer = fuse([], prior=UncertainPose(parent_from_child=pose, covariance=1e-4 * np.eye(6)))
    assert np.abs(difference(pose, answer.pose)).max() < 1e-9
    assert answer.covariance == pytest.approx(1e-4 * np.eye(6), abs=1e-9)


def test_evidence_grows_with_agreement() -> None:
    p = mixture(16, 9)
    few, many = fuse(p.measurements[:8]), fuse(p.measurements)
    assert many.evidence > few.evidence > 0
    b, used, local = used_entries(p.measurements, many)
    assert log_evidence(b, used, local) == pytest.approx(many.evidence, rel=1e-3)


def test_local_solve_reaches_the_robust_answer_from_nearby() -> None:
    p = mixture(16, 10)
    near = solve(p.measurements, perturbed(p.base_from_object, np.full(6, 0.02)))
    answer = fuse(p.measurements)
    if not answer.rejected:
        assert np.abs(difference(answer.pose, near.base_from_object)).max() < 1e-6
    assert near.dof == sum(m.dof for m in p.measurements) - 6
