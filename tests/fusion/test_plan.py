"""The next measurement is the one that tells most per second, and a plan ends when its tolerance is met."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from fusion import features, sensing
from fusion.features import Kind
from fusion.plan import Candidate, Tolerance, expected_measurement, next_best, plan
from fusion.solve import solve
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, point_covariance
from tests.fusion.mixtures import mixture


def test_the_predicted_covariance_is_the_one_that_comes() -> None:
    p = mixture(10, 10)
    now = solve(p.measurements[:9], p.base_from_object)
    choice = next_best(now.covariance, p.base_from_object, [Candidate(expected=p.measurements[9], cost_s=2.0)])
    after = solve(p.measurements, p.base_from_object)
    assert np.diag(choice.covariance) == pytest.approx(np.diag(after.covariance), rel=0.05)
    assert choice.gain_per_s == pytest.approx(np.log(choice.error_before / choice.error_after) / 2.0)


def test_what_is_expected_of_a_touch_tells_as_much_as_the_touch() -> None:
    p, sigma_m = mixture(10, 15), 2e-4
    face = features.plane((0.4, 0.25, 0.0), (0.0, 0.0, 1.0))
    finger = RigidTransform.from_translation(p.base_from_object.apply(face.point_m))
    touched = sensing.touch(face, UncertainPose(parent_from_child=finger, covariance=np.zeros((6, 6))), sigma_m=sigma_m)
    expected = expected_measurement(face, Kind.POINT, p.base_from_object, C_m2=sigma_m**2 * np.eye(3))
    now = solve(p.measurements[:9], p.base_from_object).covariance
    first, second = (
        next_best(now, p.base_from_object, [Candidate(expected=m, cost_s=1.0)]) for m in (touched, expected)
    )
    assert np.diag(second.covariance) == pytest.approx(np.diag(first.covariance), rel=1e-4)
    assert first.error_after < 0.95 * first.error_before


def test_cheap_beats_dear_when_both_tell_the_same() -> None:
    p = mixture(10, 11)
    now = solve(p.measurements[:9], p.base_from_object)
    same = [Candidate(expected=p.measurements[9], cost_s=cost) for cost in (3.0, 1.0, 2.0)]
    assert next_best(now.covariance, p.base_from_object, same).index == 1


def test_a_plan_stops_when_the_tolerance_is_met_and_is_no_longer_than_the_given_order() -> None:
    p = mixture(16, 12)
    wide = np.diag([1.0] * 3 + [3.0] * 3)
    offered = [Candidate(expected=m, cost_s=1.0) for m in p.measurements]
    tolerance = Tolerance(at_m=(0.4, 0.25, 0.0))
    chosen = plan(wide, p.base_from_object, offered, tolerance=tolerance)
    assert chosen[-1].error_after <= 1.0 < chosen[-1].error_before
    assert len({c.index for c in chosen}) == len(chosen)
    in_order = plan(wide, p.base_from_object, offered[: len(chosen) - 1], tolerance=tolerance)
    assert in_order[-1].error_after > 1.0


def test_the_error_is_that_of_the_place_that_matters() -> None:
    p, A = mixture(4, 14), np.random.default_rng(14).normal(size=(6, 6)) * 1e-3
    now, place = UncertainPose(parent_from_child=p.base_from_object, covariance=A @ A.T), (0.4, 0.25, 0.1)
    tolerance = Tolerance(position_m=0.002, angle_rad=0.01, at_m=place)
    offered = [Candidate(expected=p.measurements[0], cost_s=1.0)]
    choice = next_best(now.covariance, p.base_from_object, offered, tolerance=tolerance)
    shift, turn = np.trace(point_covariance(now, place)) / 0.002**2, np.trace(now.covariance[3:, 3:]) / 0.01**2
    assert choice.error_before == pytest.approx(0.5 * (shift + turn))


def test_planning_needs_a_candidate_with_a_cost() -> None:
    p = mixture(3, 13)
    with pytest.raises(InvalidRequest):
        next_best(np.eye(6), p.base_from_object, [])
    with pytest.raises(InvalidRequest):
        next_best(np.eye(6), p.base_from_object, [Candidate(expected=p.measurements[0], cost_s=0.0)])
