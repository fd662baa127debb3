"""The dimensions of an object are found together with its pose, and wrong touches are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from examples.paper.cylinder_radius import arc_case, box_case, cylinder_case, sensed_point
from fusion import fuse
from fusion.errors import Contradiction
from fusion.measurement import Measurement
from fusion.shapes import Box, Cylinder
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose
from tests.fusion.mixtures import mixture


def test_a_radius_comes_out_of_touches_and_the_bad_ones_are_named() -> None:
    answer, true = cylinder_case()
    assert answer.shape is not None
    assert {3, 9} <= {r.index for r in answer.rejected}
    sigmas = np.sqrt(np.diag(answer.shape.covariance))
    assert np.abs((answer.shape.values - true.start) / sigmas).max() < 4.0
    assert answer.shape.sigma_of("radius_m") < 0.0005


def test_a_third_of_a_wall_gives_the_radius_although_a_quarter_of_the_points_is_wrong() -> None:
    for seed in range(3):
        answer, true = arc_case(seed)
        assert answer.shape is not None
        named = {r.index for r in answer.rejected}
        assert len(named & set(range(0, 40, 4))) >= 9
        assert len(named - set(range(0, 40, 4))) <= 2
        error, sigma = answer.shape.value_of("radius_m") - true.radius_m, answer.shape.sigma_of("radius_m")
        assert abs(error) < 4 * sigma
        assert 0.0003 < sigma < 0.004


def test_a_box_is_measured_with_its_pose() -> None:
    answer, true = box_case()
    assert answer.shape is not None
    assert not answer.rejected
    assert answer.shape.values == pytest.approx(true.start, abs=0.001)


def test_a_shape_needs_a_believed_pose() -> None:
    with pytest.raises(InvalidRequest, match="initial pose"):
        fuse(mixture(4, 15).measurements, shape=Box(size_m=(0.1, 0.1, 0.1)))


@pytest.mark.parametrize("proof", [{"certify": True}, {"prove_set_within_s": 1.0}])
def test_what_cannot_be_proven_of_a_shape_is_refused_not_left_out(proof: dict[str, float]) -> None:
    touches, prior, guess = touched_box()
    with pytest.raises(InvalidRequest, match="nothing can be proven"):
        fuse(touches, prior=prior, shape=guess, **proof)  # type: ignore[arg-type]  # one of two options


def touched_box() -> tuple[list[Measurement], UncertainPose, Box]:
    """Return two touches on each true face of a box at the origin, a prior of the pose, and the assumed box."""
    guess = Box(size_m=(0.2, 0.1, 0.04))
    half, touches = np.array(guess.size_m) / 2, []
    for part in ("+x", "-x", "+y", "-y", "+z", "-z"):
        k, sign = "xyz".index(part[1]), 1.0 if part[0] == "+" else -1.0
        for along in (-0.5, 0.6):
            on_face = along * half
            on_face[k] = sign * half[k]
            rng = np.random.default_rng(len(touches))
            touches.append(sensed_point(guess, part, on_face, RigidTransform.identity(), 3e-4, rng))
    prior = UncertainPose(parent_from_child=RigidTransform.identity(), covariance=1e-4 * np.eye(6))
    return touches, prior, guess


def test_a_touch_that_is_given_twice_says_no_more_of_a_shape_than_once() -> None:
    touches, prior, guess = touched_box()
    once, twice = fuse(touches, prior=prior, shape=guess), fuse([touches[0], *touches], prior=prior, shape=guess)
    assert twice.covariance == pytest.approx(once.covariance)
    assert twice.chi_square == pytest.approx(once.chi_square)
    assert [(r.index, r.reason) for r in twice.rejected] == [(1, "duplicate of measurement 0")]
    assert twice.values[1:] == pytest.approx(once.values)
    assert twice.values[0] == twice.values[1]


def test_touches_of_a_shape_that_agree_only_by_chance_are_refused() -> None:
    touches, prior, guess = touched_box()
    rng = np.random.default_rng(7)
    strewn = [replace(m, mu_m=m.mu_m + rng.uniform(-0.5, 0.5, 3)) for m in touches]
    with pytest.raises(Contradiction):
        fuse(strewn, prior=prior, shape=guess)


def test_a_shape_knows_its_parts() -> None:
    post = Cylinder(radius_m=0.02, length_m=0.1)
    wall = post.feature("wall", post.start, np.array([0.0, 0.05, 0.03]))
    assert wall.point_m == pytest.approx([0.0, 0.02, 0.03])
    assert wall.direction == pytest.approx([0.0, 1.0, 0.0])
    with pytest.raises(InvalidRequest, match="no part"):
        post.feature("lid", post.start, np.zeros(3))
    edge = Box(size_m=(0.2, 0.1, 0.04)).feature("+x-z", np.array([0.2, 0.1, 0.04]), np.zeros(3))
    assert edge.point_m == pytest.approx([0.1, 0.0, -0.02])
    assert abs(edge.direction) == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize(("sigma_m", "dof"), [(0.02, 9), (1e-6, 12)])
def test_measures_that_the_touches_tell_cost_degrees_of_freedom(sigma_m: float, dof: int) -> None:
    touches, prior, guess = touched_box()  # twelve constraints, and six of the prior on the pose
    answer = fuse(touches, prior=prior, shape=replace(guess, sigma_m=sigma_m))
    assert answer.dof == dof
