"""The next measurement is the one with the most information per second, and its information is as predicted."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import Observation, PoseTolerance, TouchObservation, error_budget
from fusion.planning import CandidateSensing, next_measurement
from fusion.shared_errors import ErrorBudget, fuse_observations
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, point_covariance
from tests.fusion.test_shared_errors import BASE_FROM_PANEL, MOUNTS, draw


def split(seed: int) -> tuple[list[Observation], list[Observation]]:
    """Return candidates: rays to the lights, touches and distances at four places."""
    drawn = draw(np.random.default_rng(seed))
    return drawn[:4], drawn[4:]


def budget_of(observations: list[Observation]) -> ErrorBudget:
    return error_budget(observations, MOUNTS, BASE_FROM_PANEL)


def test_budgets_add_up_to_the_budget_of_all_together() -> None:
    rays, rest = split(1)
    parts, whole = budget_of(rays).plus(budget_of(rest)), budget_of([*rays, *rest])
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-6, atol=1e-16)


def test_the_expected_covariance_is_the_one_that_comes() -> None:
    rays, rest = split(2)
    choice = next_measurement(budget_of(rays), BASE_FROM_PANEL, [CandidateSensing(budget=budget_of(rest), cost_s=2.0)])
    fused = fuse_observations([*rays, *rest], MOUNTS).base_from_panel
    came = PoseTolerance().error_of(fused.covariance, fused.parent_from_child)
    assert choice.error_after == pytest.approx(came, rel=0.02)
    assert choice.error_after < 0.9 * choice.error_before
    assert choice.gain_per_s == pytest.approx(np.log(choice.error_before / choice.error_after) / 2.0)


def test_a_second_touch_at_the_same_place_tells_less_than_one_elsewhere() -> None:
    rays, rest = split(3)
    first, other = (o for o in rest[:4] if isinstance(o, TouchObservation))
    now = budget_of([*rays, first])
    offered = [CandidateSensing(budget=budget_of([again]), cost_s=1.0) for again in (first, other)]
    assert next_measurement(now, BASE_FROM_PANEL, offered).index == 1


def test_cheap_beats_dear_when_both_tell_the_same() -> None:
    rays, rest = split(4)
    same = [CandidateSensing(budget=budget_of(rest[:1]), cost_s=cost) for cost in (3.0, 1.0, 2.0)]
    assert next_measurement(budget_of(rays), BASE_FROM_PANEL, same).index == 1


def test_the_error_is_that_of_the_place_that_matters() -> None:
    A, place = np.random.default_rng(14).normal(size=(6, 6)) * 1e-3, (0.4, 0.25, 0.1)
    pose = UncertainPose(parent_from_child=BASE_FROM_PANEL, covariance=A @ A.T)
    error = PoseTolerance(position_m=0.002, angle_rad=0.01, at_m=place).error_of(pose.covariance, BASE_FROM_PANEL)
    shift, turn = np.trace(point_covariance(pose, place)) / 0.002**2, np.trace(pose.covariance[3:, 3:]) / 0.01**2
    assert error == pytest.approx(0.5 * (shift + turn))


def test_a_choice_needs_a_candidate_with_a_cost() -> None:
    rays, rest = split(5)
    with pytest.raises(InvalidRequest, match="no candidate"):
        next_measurement(budget_of(rays), BASE_FROM_PANEL, [])
    with pytest.raises(InvalidRequest, match="costs 0"):
        next_measurement(budget_of(rays), BASE_FROM_PANEL, [CandidateSensing(budget=budget_of(rest[:1]), cost_s=0.0)])
