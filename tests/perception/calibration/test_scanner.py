"""Tests of calibrating a range scanner on the hand by simulated scans of a plate, with lines and with images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.errors import InvalidRequest, NotObservable
from hal.geometry import UncertainPose, difference, matrix_of, perturbed, transform, transform_rpy
from perception.calibration.calibration_poses import stations
from perception.calibration.scanner import ScannerView, calibrate_scanner

Y_TRUE = transform_rpy([0.05, 0.02, 0.04], [0.05, -0.1, 0.2])
PLATE = transform_rpy([0.8, 0.0, 0.4], [0.0, -np.pi / 2, 0.0])
PLATE_COVARIANCE = np.diag([5e-4**2] * 3 + [1e-3**2] * 3)
SIGMA_M = 0.002


def scan(flange: RigidTransform, rng: np.random.Generator, *, is_line: bool) -> ScannerView:
    scanner = flange * Y_TRUE
    angles = np.linspace(-0.4, 0.4, 60)
    rays = np.column_stack([np.sin(angles), np.zeros(60), np.cos(angles)])
    if not is_line:
        rays = np.vstack([Rotation.from_rotvec([tilt, 0, 0]).apply(rays[::6]) for tilt in np.linspace(-0.3, 0.3, 6)])
    n = matrix_of(PLATE)[:, 2]
    world = scanner.rotation.apply(rays)
    depth = (n @ (PLATE.translation - scanner.translation)) / (world @ n)
    return ScannerView(
        base_from_flange=flange, points_m=rays * (depth + rng.normal(scale=SIGMA_M, size=len(rays)))[:, None],
        sigma_m=SIGMA_M,
    )  # fmt: skip


def flanges(count: int) -> list[RigidTransform]:
    near = stations(PLATE, Y_TRUE, distance_m=0.4, count=count, cone_rad=0.6)
    far = stations(PLATE, Y_TRUE, distance_m=0.7, count=count, cone_rad=0.6)
    turned = [f * transform(Rotation.from_rotvec([0, 0, 0.5 * k]).as_matrix(), np.zeros(3)) for k, f in enumerate(far)]
    return near + turned


@pytest.mark.parametrize("is_line", [True, False])
def test_errors_match_the_covariance(is_line: bool) -> None:
    rng = np.random.default_rng(1)
    nees = []
    for _ in range(25):
        plate = perturbed(PLATE, rng.multivariate_normal(np.zeros(6), PLATE_COVARIANCE))
        made = [scan(f, rng, is_line=is_line) for f in flanges(6)]
        start = perturbed(Y_TRUE, rng.normal(scale=[0.01] * 3 + [0.05] * 3))
        result = calibrate_scanner(made, start, UncertainPose(parent_from_child=plate, covariance=PLATE_COVARIANCE))
        e = difference(Y_TRUE, result.flange_from_scanner.parent_from_child)
        nees.append(e @ np.linalg.solve(result.flange_from_scanner.covariance, e) / 6.0)
        assert result.chi_square == pytest.approx(result.degrees, rel=0.25)
        assert np.linalg.norm(e[:3]) < 0.006
    assert 0.6 < np.mean(nees) < 1.5


def test_scans_from_one_side_leave_a_named_direction_free() -> None:
    rng = np.random.default_rng(2)
    first = flanges(3)[0]
    shifted = [RigidTransform.from_translation([0.0, 0.02 * k, 0.01 * k]) * first for k in range(8)]
    with pytest.raises(NotObservable, match=r"uncertain|not determine") as refused:
        calibrate_scanner([scan(f, rng, is_line=True) for f in shifted], Y_TRUE,
                          UncertainPose(parent_from_child=PLATE, covariance=PLATE_COVARIANCE))  # fmt: skip
    assert "tilted" in refused.value.hint or "differ" in refused.value.hint


def test_bad_scans_are_refused() -> None:
    rng = np.random.default_rng(3)
    plate = UncertainPose(parent_from_child=PLATE, covariance=PLATE_COVARIANCE)
    with pytest.raises(InvalidRequest, match="no scans"):
        calibrate_scanner([], Y_TRUE, plate)
    good = scan(flanges(2)[0], rng, is_line=True)
    good.points_m[3] = np.inf
    with pytest.raises(InvalidRequest, match=r"views\[0\]"):
        calibrate_scanner([good], Y_TRUE, plate)


def test_what_stands_on_the_plate_does_not_pull() -> None:
    rng = np.random.default_rng(4)
    plate = UncertainPose(parent_from_child=PLATE, covariance=PLATE_COVARIANCE)
    clean = [scan(f, rng, is_line=False) for f in flanges(6)]
    dirty = []
    for view in clean:
        points = view.points_m.copy()
        points[::12] *= 0.95  # 20 mm nearer, like a meter on the plate
        dirty.append(ScannerView(base_from_flange=view.base_from_flange, points_m=points, sigma_m=view.sigma_m))
    results = [calibrate_scanner(made, Y_TRUE, plate) for made in (clean, dirty)]
    poses = [result.flange_from_scanner.parent_from_child for result in results]
    assert np.linalg.norm(difference(poses[0], poses[1])[:3]) < 1e-3
    assert results[1].degrees < results[0].degrees
