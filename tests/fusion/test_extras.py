"""Certificate, next measurement, one more or less, drawings, shapes, warm-up."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from examples.cylinder_radius import arc_case, box_case, cylinder_case, sensed_point
from examples.table2 import outlines, remark
from fusion import fuse, incremental, warm_up
from fusion.batch import pack
from fusion.certify import certificate, quadratic_forms
from fusion.draw import Drawing, box_outlines, circle_outline, seen, sight_of, svg
from fusion.dual import minimiser, seen_from
from fusion.errors import Contradiction
from fusion.measurement import Measurement
from fusion.plan import Candidate, Tolerance, next_best, plan
from fusion.reference import residual
from fusion.relaxation import constraints, relaxed
from fusion.robust import used_entries
from fusion.shapes import Box, Cylinder
from fusion.simulate import CODES, Problem, problem
from fusion.solve import solve
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, difference, matrix_of, transform


def mixture(count: int, seed: int, bad: int = 0) -> Problem:
    rng = np.random.default_rng(seed)
    return problem([CODES[k] for k in rng.integers(len(CODES), size=count)], rng, bad=bad)


# --- certificate -----------------------------------------------------------------------------------------------------


def test_every_pose_obeys_the_constraints() -> None:
    A, right = constraints()
    rng = np.random.default_rng(0)
    for _ in range(5):
        pose = mixture(1, int(rng.integers(1000))).base_from_object
        R, t = matrix_of(pose), np.array(pose.translation)
        z = np.concatenate([[1.0], R.ravel(), t, -R.T @ t])
        assert np.einsum("i,kij,j->k", z, A, z) == pytest.approx(right, abs=1e-12)


def lifted(p: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The problem's quadratic form frozen at its true pose, and that pose."""
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


# --- one more, one less ----------------------------------------------------------------------------------------------


def test_adding_and_removing_agree_with_fusing_at_once() -> None:
    p = mixture(17, 5, bad=2)
    grown = incremental.add(incremental.start(p.measurements[:16]), p.measurements[16])
    assert np.abs(difference(fuse(p.measurements).pose, grown.answer.pose)).max() < 1e-6
    shrunk = incremental.remove(grown, 4)
    left = [m for i, m in enumerate(p.measurements) if i != 4]
    assert np.abs(difference(fuse(left).pose, shrunk.answer.pose)).max() < 1e-6


def test_a_bad_one_added_is_named_and_moves_nothing() -> None:
    good, other = mixture(12, 6), mixture(12, 7)
    before = incremental.start(good.measurements)
    after = incremental.add(before, other.measurements[0])
    assert 12 in {r.index for r in after.answer.rejected}
    assert np.abs(difference(before.answer.pose, after.answer.pose)).max() < 1e-6


def test_a_repeated_measurement_is_refused() -> None:
    p = mixture(8, 8)
    with pytest.raises(InvalidRequest) as caught:
        incremental.add(incremental.start(p.measurements), p.measurements[2])
    assert caught.value.details["index"] == 8


def test_removing_what_is_not_there_is_refused() -> None:
    with pytest.raises(InvalidRequest):
        incremental.remove(incremental.start(mixture(8, 9).measurements), 8)


# --- next measurement ------------------------------------------------------------------------------------------------


def test_the_predicted_covariance_is_the_one_that_comes() -> None:
    p = mixture(10, 10)
    now = solve(p.measurements[:9], p.base_from_object)
    choice = next_best(now.covariance, p.base_from_object, [Candidate(expected=p.measurements[9], cost_s=2.0)])
    after = solve(p.measurements, p.base_from_object)
    assert np.diag(choice.covariance) == pytest.approx(np.diag(after.covariance), rel=0.05)
    assert choice.gain_per_s == pytest.approx(np.log(choice.error_before / choice.error_after) / 2.0)


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


def test_planning_needs_a_candidate_with_a_cost() -> None:
    p = mixture(3, 13)
    with pytest.raises(InvalidRequest):
        next_best(np.eye(6), p.base_from_object, [])
    with pytest.raises(InvalidRequest):
        next_best(np.eye(6), p.base_from_object, [Candidate(expected=p.measurements[0], cost_s=0.0)])


# --- drawings --------------------------------------------------------------------------------------------------------


def test_a_drawing_is_valid_svg_with_every_visible_line() -> None:
    pose = transform(np.eye(3), (0.5, 0.0, 0.3))
    sight = sight_of(pose, (0.4, 0.25, 0.0), distance_m=1.6)
    drawing = Drawing(base_from_object=pose, outlines_m=outlines(), label="actual <1>", dashed=True)
    root = ElementTree.fromstring(svg([drawing], sight, title="a & b"))  # noqa: S314 - our own text
    lines = [e for e in root if e.tag.endswith("polyline")]
    assert len(lines) == len(outlines())
    assert any(e.text == "actual <1>" for e in root)
    for polyline in seen(drawing, sight):
        assert (polyline > 0).all()
        assert (polyline < (sight.width_px, sight.height_px)).all()


def test_the_middle_is_drawn_in_the_middle() -> None:
    pose = mixture(1, 14).base_from_object
    sight = sight_of(pose, (0.1, 0.2, 0.0), distance_m=1.0)
    dot = Drawing(base_from_object=pose, outlines_m=[circle_outline((0.1, 0.2, 0.0), 1e-6)])
    assert seen(dot, sight)[0].mean(axis=0) == pytest.approx((320, 240), abs=0.1)


def test_what_is_behind_the_lens_is_cut_off() -> None:
    pose = transform(np.eye(3), np.zeros(3))
    sight = sight_of(pose, (0.0, 0.0, 0.0), distance_m=0.1)
    through = Drawing(base_from_object=pose, outlines_m=box_outlines((-1, -1, -1), (1, 1, 1)))
    assert all(np.isfinite(line).all() for line in seen(through, sight))


# --- shapes ----------------------------------------------------------------------------------------------------------


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
    with pytest.raises(InvalidRequest, match="believed pose"):
        fuse(mixture(4, 15).measurements, shape=Box(size_m=(0.1, 0.1, 0.1)))


@pytest.mark.parametrize("proof", [{"certify": True}, {"prove_set_within_s": 1.0}])
def test_what_cannot_be_proven_of_a_shape_is_refused_not_left_out(proof: dict[str, float]) -> None:
    touches, prior, guess = touched_box()
    with pytest.raises(InvalidRequest, match="nothing can be proven"):
        fuse(touches, prior=prior, shape=guess, **proof)  # type: ignore[arg-type]  # one of two options


def touched_box() -> tuple[list[Measurement], UncertainPose, Box]:
    """Two touches on each face of a box at the origin, on its true faces; a believed pose; the box as it is believed."""
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


# --- the rest --------------------------------------------------------------------------------------------------------


def test_warming_up_twice_is_harmless() -> None:
    warm_up()
    warm_up()


def test_the_example_says_why_it_has_no_pose() -> None:
    assert "refused" in remark(None)
    assert "free: turn about" in remark(fuse(problem(["1t"], np.random.default_rng(0)).measurements))
