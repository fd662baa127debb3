"""Tests of hand-eye and robot-world calibration: simulated poses, covariance statistics, degenerate sets, next pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, difference, perturbed, transform, transform_rpy
from perception.calibration.hand_eye import calibrate_hand_eye, propose_next, stations
from perception.calibration.hand_eye_equation import HandEyeView

X_TRUE = transform_rpy([0.03, -0.05, 0.08], [0.02, -0.03, np.pi / 2])
Z_TRUE = transform_rpy([0.7, 0.1, 0.4], [0.0, -np.pi / 2, 0.3])
ARM = np.diag([1e-4**2] * 6)
# Covariance that `vision.quadrangle` states for lights 560 x 400 mm apart at 0.6 m, f = 800 px, 0.15 px, rounded up.
SEEN = np.diag([2e-4**2, 2e-4**2, 5e-4**2, 8e-4**2, 8e-4**2, 3e-4**2])


def station_views(
    flanges: list[RigidTransform], seed: int, seen: np.ndarray = SEEN, arm: np.ndarray = ARM
) -> list[HandEyeView]:
    rng = np.random.default_rng(seed)
    made = []
    for flange in flanges:
        real = perturbed(flange, rng.multivariate_normal(np.zeros(6), arm))
        exact = (real * X_TRUE).inv() * Z_TRUE
        noisy = perturbed(exact, rng.multivariate_normal(np.zeros(6), seen))
        pose = UncertainPose(parent_from_child=noisy, covariance=seen)
        made.append(HandEyeView(base_from_flange=flange, camera_from_target=pose))
    return made


def good_flanges(count: int = 12) -> list[RigidTransform]:
    return stations(Z_TRUE, X_TRUE, distance_m=0.5, count=count)


def test_exact_views_give_the_exact_mount() -> None:
    tiny = np.diag([1e-9**2] * 6)
    result = calibrate_hand_eye(station_views(good_flanges(), 0, tiny, tiny))
    assert np.abs(difference(X_TRUE, result.flange_from_camera.parent_from_child)).max() < 1e-7
    assert np.abs(difference(Z_TRUE, result.base_from_target.parent_from_child)).max() < 1e-7


def test_twelve_views_reach_the_goal() -> None:
    for seed in range(10):
        found = calibrate_hand_eye(station_views(good_flanges(), seed)).flange_from_camera.parent_from_child
        e = difference(X_TRUE, found)
        assert np.linalg.norm(e[:3]) < 1e-3
        assert np.degrees(np.linalg.norm(e[3:])) < 0.2


def test_errors_match_the_covariance() -> None:
    nees, ratio = [], []
    for seed in range(25):
        result = calibrate_hand_eye(station_views(good_flanges(), 1000 + seed))
        e = np.concatenate(
            [
                difference(X_TRUE, result.flange_from_camera.parent_from_child),
                difference(Z_TRUE, result.base_from_target.parent_from_child),
            ]
        )
        nees.append(e @ np.linalg.solve(result.covariance, e) / 12.0)
        ratio.append(result.chi_square / result.degrees)
    assert 0.75 < np.mean(nees) < 1.25
    assert 0.9 < np.mean(ratio) < 1.1


def test_a_view_of_something_else_is_left_out_by_its_number() -> None:
    made = station_views(good_flanges(), 3)
    wrong = perturbed(made[5].camera_from_target.parent_from_child, [0.03, 0, 0, 0, 0.1, 0])
    made[5] = HandEyeView(
        base_from_flange=made[5].base_from_flange,
        camera_from_target=UncertainPose(parent_from_child=wrong, covariance=SEEN),
    )
    result = calibrate_hand_eye(made)
    assert 5 not in result.used
    assert len(result.used) >= 10
    assert np.linalg.norm(difference(X_TRUE, result.flange_from_camera.parent_from_child)[:3]) < 1.5e-3


@pytest.mark.parametrize("kind", ["shifts only", "one axis"])
def test_degenerate_stations_are_refused_and_the_next_turn_is_named(kind: str) -> None:
    first = good_flanges(3)[1]
    flanges = []
    for k in range(8):
        turn = 0.0 if kind == "shifts only" else 0.15 * k
        shift = [0.01 * k, -0.02 * (k % 3), 0.015 * (k % 2)]
        own = transform(Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix(), shift)
        flanges.append(first * own)
    with pytest.raises(NotObservable, match="one axis") as refused:
        calibrate_hand_eye(station_views(flanges, 1))
    axis = np.array(refused.value.details["next_axis"])
    assert abs(axis[2]) < 0.1  # a rotation about another axis than z
    turned = [transform(Rotation.from_rotvec(angle * axis).as_matrix(), np.zeros(3)) for angle in (-0.5, 0.5)]
    repaired = flanges + [first * turn for turn in turned]
    if kind == "one axis":
        calibrate_hand_eye(station_views(repaired, 1))


def test_turns_that_are_too_small_are_refused_with_a_figure() -> None:
    rng = np.random.default_rng(0)
    first = good_flanges(3)[1]
    flanges = [first * transform(Rotation.from_rotvec(0.06 * rng.normal(size=3)).as_matrix(), 0.01 * rng.normal(size=3))
               for _ in range(6)]  # fmt: skip
    coarse = np.diag([2e-3**2] * 3 + [1e-2**2] * 3)
    with pytest.raises(NotObservable, match=r"mm along|one axis"):
        calibrate_hand_eye(station_views(flanges, 2, seen=coarse))


def test_two_views_are_too_few() -> None:
    with pytest.raises(InvalidRequest, match="three"):
        calibrate_hand_eye(station_views(good_flanges(2), 0))


def test_the_proposed_pose_helps_more_than_the_average_one() -> None:
    done = station_views(good_flanges(2), 4)
    candidates = stations(Z_TRUE, X_TRUE, distance_m=0.5, count=20, cone_rad=0.7)
    best, score = propose_next(done, (X_TRUE, Z_TRUE), candidates, view_covariance=lambda _: SEEN)
    others = [propose_next(done, (X_TRUE, Z_TRUE), [c], view_covariance=lambda _: SEEN)[1] for c in candidates]
    assert score == pytest.approx(min(others))
    assert score < np.mean(others) - 0.5
    assert 0 <= best < len(candidates)
    with pytest.raises(InvalidRequest):
        propose_next(done, (X_TRUE, Z_TRUE), [], view_covariance=lambda _: SEEN)


def test_stations_look_at_the_target() -> None:
    for flange in stations(Z_TRUE, X_TRUE, distance_m=0.5, count=15):
        target = ((flange * X_TRUE).inv() * Z_TRUE).translation
        np.testing.assert_allclose(target, [0.0, 0.0, 0.5], atol=1e-9)
