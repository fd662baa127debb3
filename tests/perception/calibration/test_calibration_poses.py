"""Calibration poses have the target in view, the most informative come first, and gravity has varied directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.camera_model import project
from hal.config import load_cell
from hal.errors import NotObservable
from hal.geometry import UncertainPose, matrix_of, transform_rpy
from manipulation.arm.kinematics import Kinematics
from perception.calibration.calibration_poses import (
    EDGE_PX,
    around,
    by_plate,
    in_view,
    plate_view,
    stations,
    wrist_turns,
)
from perception.calibration.in_hand import check_turns
from perception.calibration.scanner import calibrate_scanner
from perception.calibration.wrench import GRAVITY_M_PER_S2, calibrate_wrench
from tests.perception.calibration.test_scanner import PLATE, PLATE_COVARIANCE, Y_TRUE, scan

ROOT = Path(__file__).parents[3]
CELL = load_cell(ROOT / "cells/bench.toml")
LIGHTS = np.array([light.position_m for light in CELL.panel.lights])
BASE_FROM_PANEL = transform_rpy((0.95, 0.03, 0.55), (1.5, 0.1, -1.6))
X = CELL.calibration_of("wrist_camera").mount.pose().parent_from_child
LENS = CELL.calibration_of("wrist_camera").intrinsics.intrinsics()


def test_stations_look_at_the_middle_from_the_front() -> None:
    flanges = around(BASE_FROM_PANEL, X, 0.6, steps=(1.0, 1.3), cone_rad=0.6)
    for flange in flanges:
        middle = ((flange * X).inv() * BASE_FROM_PANEL).apply([0.0, 0.0, 0.0])
        assert np.allclose(middle[:2], 0.0, atol=1e-9)
        assert 0.59 < middle[2] < 0.79
        assert (BASE_FROM_PANEL.inv() * flange * X).translation[2] > 0.3
    assert {round(float(np.linalg.norm(((f * X).inv() * BASE_FROM_PANEL).translation)), 3) for f in flanges} == {
        0.6,
        0.78,
    }


def test_in_view_means_clear_of_the_edge() -> None:
    near, far = (around(BASE_FROM_PANEL, X, distance_m, steps=(1.0,), cone_rad=0.6)[0] for distance_m in (0.35, 0.75))
    assert in_view(far, X, BASE_FROM_PANEL, LIGHTS, LENS)
    assert not in_view(near, X, BASE_FROM_PANEL, LIGHTS, LENS)
    pixels = project(((far * X).inv() * BASE_FROM_PANEL).apply(LIGHTS), LENS)
    assert (pixels > EDGE_PX).all()
    behind = transform_rpy((2.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    assert not in_view(behind, X, BASE_FROM_PANEL, LIGHTS, LENS)


def test_a_plate_tells_its_height_and_tilts_in_any_pose() -> None:
    for pose in (transform_rpy((0.0, 0.0, 0.5), (0.0, 0.0, 0.0)), transform_rpy((0.1, 0.0, 0.5), (2.6, 0.3, 0.7))):
        covariance, normal = plate_view(pose), matrix_of(pose)[:, 2]
        assert normal @ covariance[:3, :3] @ normal < 1e-6 < np.linalg.eigvalsh(covariance[:3, :3])[1]
        assert normal @ covariance[3:, 3:] @ normal > 0.5


def test_the_first_stations_chosen_for_a_scanner_turn_about_several_axes() -> None:
    candidates = around(BASE_FROM_PANEL, X, 0.45, steps=(1.0,), cone_rad=0.6)
    propose = by_plate(X, BASE_FROM_PANEL)
    done: list[RigidTransform] = []
    for _ in range(4):
        done.append(candidates.pop(propose(done, candidates)))
    check_turns(done)  # raises if not


def test_the_proposed_pose_helps_a_scanner_more_than_the_average_one() -> None:
    candidates = around(PLATE, Y_TRUE, 0.45, steps=(1.0,), cone_rad=0.6)
    done = stations(PLATE, Y_TRUE, distance_m=0.4, count=6, cone_rad=0.6)
    rng = np.random.default_rng(5)
    plate = UncertainPose(parent_from_child=PLATE, covariance=PLATE_COVARIANCE)

    def log_determinant(more: RigidTransform) -> float:
        found = calibrate_scanner([scan(f, rng, is_line=False) for f in [*done, more]], Y_TRUE, plate)
        return float(np.linalg.slogdet(found.flange_from_scanner.covariance)[1])

    best = by_plate(Y_TRUE, PLATE)(done, candidates)
    assert log_determinant(candidates[best]) < np.mean([log_determinant(pose) for pose in candidates[::3]])


def test_stations_look_straight_at_the_target() -> None:
    for flange in stations(PLATE, Y_TRUE, distance_m=0.5, count=15):
        target = ((flange * Y_TRUE).inv() * PLATE).translation
        np.testing.assert_allclose(target, [0.0, 0.0, 0.5], atol=1e-9)


def test_wrist_turns_tell_weight_from_bias_within_the_limits() -> None:
    from simbackend.arm_model import t3

    capabilities = t3().capabilities
    arm = Kinematics.of(capabilities)
    low, high = np.array(capabilities.lower_rad), np.array(capabilities.upper_rad)
    park_rad = np.array(CELL.file.workspace.park_rad)
    ordered = wrist_turns(park_rad, (low, high), lambda q: matrix_of(arm.flange(q)))
    assert all((q > low).all() and (q < high).all() for q in ordered)
    rotations = np.array([matrix_of(arm.flange(q)) for q in ordered[:8]])
    down = np.einsum("nji,j->ni", rotations, [0.0, 0.0, -GRAVITY_M_PER_S2])
    wrenches = np.hstack([0.9 * down + [1.0, 2.0, 3.0], np.cross([0.0, 0.0, 0.08], 0.9 * down)])
    try:
        load = calibrate_wrench(rotations, wrenches).load
    except NotObservable as error:
        raise AssertionError(f"the stations tell too little: {error}") from error
    assert abs(load.mass_kg - 0.9) < 1e-9
    assert np.allclose(load.bias[:3], [1.0, 2.0, 3.0])
