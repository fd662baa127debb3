"""Calibration records are written, read back, and get increasing versions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hal.calibration import CalibrationRecord, MountRecord, load_calibration
from hal.geometry import UncertainPose, difference, transform_rpy
from hal.strict import parse_toml
from perception.calibration.in_hand import calibrate_in_hand
from perception.calibration.intrinsics import calibrate_camera
from perception.calibration.records import mount_of, record_of, renewed, to_toml
from perception.calibration.scanner import ScannerCalibration
from perception.calibration.wrench import calibrate_wrench
from tests.perception.calibration.test_in_hand import KNOWN, POINTS, drawn, start
from tests.perception.calibration.test_in_hand import poses as twelve
from tests.perception.calibration.test_intrinsics import DOTS, views
from tests.perception.calibration.test_wrench import poses, reading

# fmt: off
SCANNER = ScannerCalibration(
    flange_from_scanner=UncertainPose(
        parent_from_child=transform_rpy([0.1, 0, 0], [0, 0, 1]), covariance=1e-8 * np.eye(6)
    ),
    chi_square=90.0, degrees=100, rms_m=0.001,
)
# fmt: on


def test_a_mount_comes_back_with_its_covariance() -> None:
    pose = transform_rpy([0.1, -0.2, 0.3], [0.1, -0.4, 2.0])
    factor = np.diag([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4]) @ np.random.default_rng(1).normal(size=(6, 6))
    mount = UncertainPose(parent_from_child=pose, covariance=factor @ factor.T)
    back = mount_of(mount).pose()
    assert np.abs(difference(pose, back.parent_from_child)).max() < 1e-12
    sigma = np.sqrt(np.diag(mount.covariance))
    np.testing.assert_allclose(back.covariance, mount.covariance, atol=1e-6 * sigma.max() ** 2)


def test_an_axis_without_an_error_has_no_correlations() -> None:
    mount = UncertainPose(
        parent_from_child=transform_rpy([0.0, 0.0, 0.1], [0.0, 0.0, 0.0]), covariance=np.zeros((6, 6))
    )
    assert mount_of(mount).correlations == ()
    np.testing.assert_array_equal(mount_of(mount).pose().covariance, np.zeros((6, 6)))


@pytest.mark.parametrize(
    ("correlations", "words"), [((0.1, 0.2), "15 numbers"), ((0.9, 0.9, -0.9, *[0.0] * 12), "negative eigenvalue")]
)
def test_correlations_that_cannot_be_are_refused(correlations: tuple[float, ...], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        MountRecord(position_m=(0.0, 0.0, 0.1), rpy_rad=(0.0, 0.0, 0.0), correlations=correlations)


def test_every_kind_of_result_is_written_and_read_back(tmp_path: Path) -> None:
    R = poses(8, 1)
    results = {
        "camera": calibrate_camera(views(DOTS, 6, seed=1), (640, 480)),
        "range_scanner": SCANNER,
        "wrist_camera": calibrate_in_hand(drawn(1, twelve()), POINTS, start(), KNOWN),
        "wrist_ft": calibrate_wrench(R, [reading(r) for r in R]),
    }
    for name, result in results.items():
        record = record_of(name, result, date="2026-11-21T00:00:00Z")
        (tmp_path / f"{name}.toml").write_text(to_toml(record))
        back = load_calibration(tmp_path / f"{name}.toml")
        assert back == record
        assert back.device == name
        assert back.quality


def test_a_renewed_record_keeps_what_was_not_measured_and_counts_up() -> None:
    camera = record_of("camera", calibrate_camera(views(DOTS, 6, seed=1), (640, 480)), date="2026-11-20")
    mount = record_of("camera", SCANNER, date="2026-11-21")
    record = renewed(camera, mount)
    assert (record.version, record.date, record.method) == (2, "2026-11-21", "plate-scans")
    assert record.intrinsics == camera.intrinsics and record.mount == mount.mount
    assert record.quality == mount.quality
    assert renewed(record, camera).version == 3


def test_lens_and_mount_found_together_make_one_record(tmp_path: Path) -> None:
    result = calibrate_in_hand(drawn(1, twelve()), POINTS, start(), KNOWN)
    record = record_of("wrist_camera", result, date="2026-11-21")
    (tmp_path / "camera.toml").write_text(to_toml(record))
    back = load_calibration(tmp_path / "camera.toml")
    assert back == record and back.intrinsics is not None and back.mount is not None
    assert back.intrinsics.intrinsics() == result.intrinsics
    pose = back.mount.pose()
    assert np.allclose(difference(pose.parent_from_child, result.flange_from_camera.parent_from_child), 0.0, atol=1e-12)
    assert np.allclose(np.diag(pose.covariance), np.diag(result.flange_from_camera.covariance))
    assert 0.0 < back.quality["sigma_m"] < 1e-3 and back.quality["views"] == 12.0


@given(st.text(), st.dictionaries(st.text(min_size=1), st.floats(allow_nan=False, allow_infinity=False), max_size=3))
def test_any_text_of_a_record_survives_and_comments_of_the_file_before_stay(
    method: str, quality: dict[str, float]
) -> None:
    record = CalibrationRecord(device="wrist\ncamera", date="2026-11-21", method=method, quality=quality)
    assert parse_toml(to_toml(record), CalibrationRecord, source="record") == record
    before = "# bolted on by hand\n" + to_toml(record.model_copy(update={"method": "older", "quality": {"a": 1.0}}))
    text = to_toml(record, over=before)
    assert parse_toml(text, CalibrationRecord, source="record") == record
    assert text.startswith("# bolted on by hand")
