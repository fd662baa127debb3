"""Tests of a camera on the hand: derivatives, covariance statistics, a wrong view, degenerate sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import difference, perturbed, transform, transform_rpy
from perception.calibration.calibration_poses import stations
from perception.calibration.in_hand import InHandCalibration, calibrate_in_hand, propose_view
from perception.calibration.in_hand_model import (
    FREE,
    UNKNOWN_LENS,
    Beforehand,
    InHandState,
    InHandView,
    moved,
    residual,
)

LENS = CameraIntrinsics(width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5,
                        distortion=(-0.08, 0.02, 0.0, 0.0, 0.0))  # fmt: skip
POINTS = np.array([[-0.28, 0.18, 0.004], [0.28, 0.18, 0.004], [0.28, -0.18, 0.004], [-0.28, -0.18, 0.004]])
X_TRUE = transform_rpy([0.003, -0.09, 0.06], [0.01, -0.02, 0.015])
Z_TRUE = transform_rpy([0.95, 0.03, 0.55], [1.55, 0.05, -1.52])
KNOWN = Beforehand(focal_ratio=5e-4, centre_px=0.3, k1=2e-3)
SIGMA_PX = 0.08


def start() -> InHandState:
    return InHandState(
        flange_from_camera=transform_rpy([0.0, -0.09, 0.06], [0.0, 0.0, 0.0]),
        base_from_target=perturbed(Z_TRUE, [0.004, -0.003, 0.002, 0.01, 0.005, -0.01]),
        intrinsics=LENS, point_errors_m=np.zeros((4, 3)),
    )  # fmt: skip


def poses(count: int = 12) -> list[RigidTransform]:
    return stations(Z_TRUE, X_TRUE, distance_m=0.72, count=count, cone_rad=0.5)


def drawn(seed: int, flanges: list[RigidTransform], known: Beforehand = KNOWN) -> list[InHandView]:
    """Return views with every error drawn as stated."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal(3)
    lens = replace(LENS, fx_px=LENS.fx_px * (1 + known.focal_ratio * z[0]), fy_px=LENS.fy_px * (1 + known.focal_ratio * z[1]),
                   cx_px=LENS.cx_px + known.centre_px * z[2])  # fmt: skip
    points = POINTS + known.point_m * rng.standard_normal((4, 3))
    arm = np.repeat([known.arm_m, known.arm_rad], 3)
    views = []
    for flange in flanges:
        real = perturbed(flange, arm * rng.standard_normal(6))
        pixels = project(((real * X_TRUE).inv() * Z_TRUE).apply(points), lens)
        views.append(InHandView(
            base_from_flange=flange, pixels_px=pixels + SIGMA_PX * rng.standard_normal((4, 2)),
            covariance_px=np.tile(SIGMA_PX**2 * np.eye(2), (4, 1, 1)),
        ))  # fmt: skip
    return views


def solved(seed: int, **more: float) -> InHandCalibration:
    return calibrate_in_hand(drawn(seed, poses()), POINTS, start(), KNOWN, **more)


@pytest.mark.parametrize("disc_m", [0.0, 0.008])
def test_the_derivatives_are_those_of_finite_differences(disc_m: float) -> None:
    view, state, step = drawn(1, poses(4))[2], start(), 1e-6
    _, jacobian = residual(view, POINTS, state, disc_m)
    # The offset of a disc, 0.01 px, is kept constant while camera and target move, so only its own columns are checked.
    for k in range(0 if disc_m == 0.0 else jacobian.shape[1] - 2, jacobian.shape[1]):
        bump = np.zeros(jacobian.shape[1])
        bump[k] = step
        ahead, behind = (residual(view, POINTS, moved(state, b), disc_m)[0] for b in (bump, -bump))
        assert np.allclose((ahead - behind) / (2 * step), jacobian[:, k], rtol=1e-4, atol=1e-3), k


def test_twelve_views_of_four_lights_reach_the_goal_and_say_how_well() -> None:
    nees, ratio = [], []
    for seed in range(20):
        result = solved(seed)
        e = difference(X_TRUE, result.flange_from_camera.parent_from_child)
        assert np.linalg.norm(e[:3]) < 1e-3
        assert np.degrees(np.linalg.norm(e[3:])) < 0.2
        nees.append(e @ np.linalg.solve(result.flange_from_camera.covariance, e) / 6.0)
        ratio.append(result.chi_square / result.degrees)
    assert 0.6 < np.mean(nees) < 1.5
    assert 0.9 < np.mean(ratio) < 1.1


def test_what_all_lamps_are_off_by_does_not_pass_for_the_mount() -> None:
    known, offset = replace(KNOWN, disc_m=0.008), np.array([-1.0, 0.12])  # as in the simulated cell
    nees = []
    for seed in range(10):
        views = drawn(seed, stations(Z_TRUE, X_TRUE, distance_m=0.6, count=12, cone_rad=0.95))
        for k, view in enumerate(views):
            seen = residual(view, POINTS, replace(start(), offset=offset), known.disc_m)[0]
            plain = residual(view, POINTS, replace(start(), offset=np.zeros(2)), known.disc_m)[0]
            views[k] = replace(view, pixels_px=view.pixels_px + (seen - plain).reshape(-1, 2))
        result = calibrate_in_hand(views, POINTS, start(), known)
        e = difference(X_TRUE, result.flange_from_camera.parent_from_child)
        nees.append(e @ np.linalg.solve(result.flange_from_camera.covariance, e) / 6.0)
    assert 0.5 < np.mean(nees) < 1.6


def test_an_unknown_lens_is_found_along_with_the_mount() -> None:
    rough = replace(
        start(), intrinsics=replace(LENS, fx_px=466.0, fy_px=466.0, cx_px=316.0, distortion=(-0.05, 0.02, 0, 0, 0))
    )
    views = drawn(5, stations(Z_TRUE, X_TRUE, distance_m=0.62, count=10, cone_rad=0.5) + poses(10))
    result = calibrate_in_hand(views, POINTS, rough, UNKNOWN_LENS, limit_m=0.005, limit_rad=0.02)
    sigma = dict(zip(FREE, result.lens_sigma, strict=True))
    assert abs(result.intrinsics.fx_px - LENS.fx_px) < 4 * sigma["fx"] < 8.0
    assert abs(result.intrinsics.cx_px - LENS.cx_px) < 4 * sigma["cx"] < 40.0


def test_a_view_of_something_else_is_left_out_by_its_number() -> None:
    views = drawn(3, poses())
    views[5] = replace(views[5], pixels_px=views[5].pixels_px[[1, 2, 3, 0]])
    result = calibrate_in_hand(views, POINTS, start(), KNOWN)
    assert 5 not in result.used and len(result.used) >= 10
    assert np.linalg.norm(difference(X_TRUE, result.flange_from_camera.parent_from_child)[:3]) < 1e-3


@pytest.mark.parametrize("kind", ["shifts only", "one axis"])
def test_turns_about_one_axis_are_refused_and_another_is_named(kind: str) -> None:
    first, turns = poses(1)[0], np.linspace(-0.3, 0.3, 8) * (kind == "one axis")
    flanges = [perturbed(first, [0.02 * np.sin(k), 0.01 * k, 0, 0, 0, a]) for k, a in enumerate(turns)]
    with pytest.raises(NotObservable, match="one axis") as refused:
        calibrate_in_hand(drawn(2, flanges), POINTS, start(), KNOWN)
    axis = np.array(refused.value.details["next_axis"])
    if kind == "one axis":
        assert abs(axis @ first.rotation.inv().apply([0.0, 0.0, 1.0])) < 0.1
        turned = [
            first * transform(Rotation.from_rotvec(angle * axis).as_matrix(), np.zeros(3)) for angle in (-0.5, 0.5)
        ]
        calibrate_in_hand(drawn(2, flanges + turned), POINTS, start(), KNOWN, limit_m=0.005, limit_rad=0.02)


def test_too_little_turning_is_refused_with_the_direction_that_stays_open() -> None:
    rng = np.random.default_rng(0)
    flanges = [
        perturbed(poses(1)[0], [0, 0, 0, *Rotation.random(random_state=rng).apply([0.06, 0, 0])]) for _ in range(6)
    ]
    with pytest.raises(NotObservable, match="uncertain by"):
        calibrate_in_hand(drawn(2, flanges), POINTS, start(), KNOWN)


def test_unusable_views_are_named() -> None:
    views = drawn(1, poses(5))
    with pytest.raises(InvalidRequest, match="four are the least"):
        calibrate_in_hand(views[:3], POINTS, start(), KNOWN)
    broken = replace(views[1], pixels_px=np.full((4, 2), np.nan))
    with pytest.raises(InvalidRequest, match=r"views\[1\]"):
        calibrate_in_hand([views[0], broken, *views[2:]], POINTS, start(), KNOWN)


def test_the_next_view_is_the_one_after_which_the_mount_is_known_best() -> None:
    candidates, state = poses(10), start()
    done = [candidates.pop(0)]
    best, sigma = propose_view(done, candidates, POINTS, state, KNOWN)
    assert sigma == min(propose_view(done, [pose], POINTS, state, KNOWN)[1] for pose in candidates)
    assert propose_view([*done, candidates[best]], candidates, POINTS, state, KNOWN)[1] < sigma
    with pytest.raises(InvalidRequest, match="no candidate"):
        propose_view(done, [], POINTS, state, KNOWN)


def test_what_is_promised_of_the_stations_is_what_the_fit_states() -> None:
    flanges = poses(12)
    promised = propose_view(flanges[:-1], flanges[-1:], POINTS, start(), KNOWN, sigma_px=SIGMA_PX)[1]
    result = calibrate_in_hand(drawn(1, flanges), POINTS, start(), KNOWN)
    variance = np.diag(result.flange_from_camera.covariance)
    scatter = max(1.0, result.chi_square / result.degrees)
    assert np.sqrt((variance[:3].sum() + 0.01 * variance[3:].sum()) / scatter) == pytest.approx(promised, rel=0.1)
