"""A line scanner swept by the wrist: planes come out flat though the wrist moved during each scan."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from drivers.sweep import PoseTrack, beam_times_s, scan_points, sweep_points
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import InvalidRequest, StaleReading
from hal.geometry import identity, transform_rpy
from hal.readings import Cause, Quality, Stamped

LINE = RangeScannerCapabilities(
    projection="polar",
    width=181,
    height=1,
    fx=1.0,
    fy=1.0,
    cx=0.0,
    cy=0.0,
    min_range_m=0.02,
    max_range_m=4.0,
    sigma_m=0.01,
    rate_hz=10.0,
    first_angle_rad=-np.pi / 4,
    step_angle_rad=np.pi / 360,
)
IMAGE = RangeScannerCapabilities(
    projection="orthographic",
    width=64,
    height=48,
    fx=100.0,
    fy=100.0,
    cx=32.0,
    cy=24.0,
    min_range_m=0.1,
    max_range_m=4.0,
    sigma_m=0.01,
    rate_hz=1.0,
)
WRIST_FROM_SCANNER = transform_rpy([0.02, -0.01, 0.05], [0.02, -0.03, 0.1])
PLANE_Z_M = 1.0


def wrist_at(time_s: float) -> RigidTransform:
    """Moving at 0.3 m/s and nodding at 0.4 rad/s, with the scanner looking along the base's z."""
    return RigidTransform.from_components(
        [0.05 * np.sin(time_s), 0.3 * (time_s - 0.5), 0.02 * time_s], Rotation.from_rotvec([0.4 * time_s, 0.1, 0.0])
    )


def track() -> PoseTrack:
    times_s = list(np.arange(-0.2, 1.4, 0.008))
    return PoseTrack(times_s, [wrist_at(t) for t in times_s])


def scan_of_the_plane(end_s: float) -> Stamped[RangeImage]:
    """Each beam meets z = 1 m of the base from where the scanner was at the beam's own time."""
    range_m = []
    for k, t in enumerate(beam_times_s(end_s, LINE)):
        base_from_scanner = wrist_at(float(t)) * WRIST_FROM_SCANNER
        angle = LINE.first_angle_rad + k * LINE.step_angle_rad
        along = base_from_scanner.rotation.apply([np.sin(angle), 0.0, np.cos(angle)])
        range_m.append((PLANE_Z_M - base_from_scanner.translation[2]) / along[2])
    depth_m = np.array([range_m], np.float32)
    return Stamped(value=RangeImage(depth_m=depth_m), host_time_s=end_s, sequence=1)


def test_the_points_of_a_moving_scanner_lie_on_the_plane() -> None:
    scans = [scan_of_the_plane(0.1 * i) for i in range(1, 10)]
    points = sweep_points(scans, LINE, track(), WRIST_FROM_SCANNER)
    assert len(points) == 9 * LINE.width
    assert np.max(np.abs(points[:, 2] - PLANE_Z_M)) < 2e-4


def test_poses_of_another_time_would_bend_it() -> None:
    late = Stamped(value=scan_of_the_plane(0.5).value, host_time_s=0.6, sequence=1)
    assert np.max(np.abs(scan_points(late, LINE, track(), WRIST_FROM_SCANNER)[:, 2] - PLANE_Z_M)) > 5e-3


def test_the_last_beam_ends_the_scan_and_the_scanner_turns_steadily() -> None:
    times_s = beam_times_s(2.0, LINE)
    assert times_s[-1] == 2.0
    assert times_s[0] == pytest.approx(2.0 - 0.1 * 90 / 360)


def test_unseen_beams_and_invalid_scans_give_no_points() -> None:
    depth_m = np.full((1, LINE.width), np.nan, np.float32)
    depth_m[0, 90] = 1.0
    one = Stamped(value=RangeImage(depth_m=depth_m), host_time_s=0.5, sequence=1)
    bad = Stamped(value=one.value, host_time_s=0.5, sequence=2, quality=Quality.INVALID, cause=Cause.OUT_OF_RANGE)
    assert scan_points(one, LINE, track(), WRIST_FROM_SCANNER).shape == (1, 3)
    assert scan_points(bad, LINE, track(), WRIST_FROM_SCANNER).shape == (0, 3)


def test_times_without_poses_are_refused() -> None:
    with pytest.raises(StaleReading, match="no arm pose"):
        track().at(5.0)
    with pytest.raises(StaleReading, match="gap"):
        PoseTrack([0.0, 0.5], [identity(), identity()]).at(0.25)


def test_only_lines_are_swept() -> None:
    with pytest.raises(InvalidRequest, match="lines"):
        scan_points(scan_of_the_plane(0.5), IMAGE, track(), WRIST_FROM_SCANNER)
