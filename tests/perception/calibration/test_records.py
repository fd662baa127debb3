"""Records of calibrations: written, read back, counted up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.calibration import load_calibration
from hal.errors import ConfigError
from hal.geometry import UncertainPose, difference, transform_rpy
from perception.calibration.intrinsics import calibrate_camera
from perception.calibration.records import mount_of, record_of, save
from perception.calibration.scanner import ScannerCalibration
from perception.calibration.wrench import calibrate_wrench
from tests.perception.calibration.test_hand_eye import good_flanges, station_views
from tests.perception.calibration.test_intrinsics import DOTS, views
from tests.perception.calibration.test_wrench import poses, reading


def test_a_mount_comes_back_with_its_covariance() -> None:
    pose = transform_rpy([0.1, -0.2, 0.3], [0.1, -0.4, 2.0])
    mount = UncertainPose(parent_from_child=pose, covariance=np.diag([1e-6, 4e-6, 9e-6, 1e-8, 4e-8, 9e-8]))
    back = mount_of(mount).pose()
    assert np.abs(difference(pose, back.parent_from_child)).max() < 1e-12
    np.testing.assert_allclose(back.covariance, mount.covariance)


def test_every_kind_of_result_is_written_and_read_back(tmp_path: Path) -> None:
    from perception.calibration.hand_eye import calibrate_hand_eye

    R = poses(8, 1)
    mount = UncertainPose(parent_from_child=transform_rpy([0.1, 0, 0], [0, 0, 1]), covariance=1e-8 * np.eye(6))
    scanner = ScannerCalibration(flange_from_scanner=mount, plane_base=(np.array([0.0, 0, 1]), 0.5), chi_square=90.0,
                                 degrees=100, rms_m=0.001)  # fmt: skip
    results = {
        "wrist_camera": calibrate_hand_eye(station_views(good_flanges(), 1)),
        "camera": calibrate_camera(views(DOTS, 6, seed=1), (640, 480)),
        "range_scanner": scanner,
        "wrist_ft": calibrate_wrench(R, [reading(r) for r in R]),
    }
    for name, result in results.items():
        record = save(record_of(name, result, date="2026-11-21T00:00:00Z"), tmp_path / f"{name}.toml")
        back = load_calibration(tmp_path / f"{name}.toml")
        assert back == record
        assert back.device == name
        assert back.quality


def test_saving_again_counts_the_version_up(tmp_path: Path) -> None:
    R = poses(8, 1)
    record = record_of("wrist_ft", calibrate_wrench(R, [reading(r) for r in R]), date="2026-11-21T00:00:00Z")
    path = tmp_path / "wrist_ft.toml"
    assert [save(record, path).version for _ in range(3)] == [1, 2, 3]
    assert load_calibration(path).version == 3


def test_another_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text("[cell]\nname = 'bench'\n")
    R = poses(8, 1)
    record = record_of("wrist_ft", calibrate_wrench(R, [reading(r) for r in R]), date="2026-11-21T00:00:00Z")
    with pytest.raises(ConfigError):
        save(record, path)
    assert "bench" in path.read_text()
