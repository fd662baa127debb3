"""A line scanner swept by the wrist measures planes as flat although the wrist moves during each scan."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import InvalidRequest, NotFound, StaleReading
from hal.geometry import UncertainPose, identity, perturbed, transform_rpy
from hal.readings import Cause, Quality, Stamped
from perception.range import PinholeSensor, fit_plane_near
from perception.range.from_points import image_from_points
from perception.range.sweep import (
    SweepPass,
    SweptErrors,
    beam_times_s,
    delay_between,
    image_from_sweep,
)

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
    """Return a pose on a motion of 0.3 m/s and 0.4 rad/s, with the scanner looking along the base's z."""
    return RigidTransform.from_components(
        [0.05 * np.sin(time_s), 0.3 * (time_s - 0.5), 0.02 * time_s], Rotation.from_rotvec([0.4 * time_s, 0.1, 0.0])
    )


def swept(*scans: Stamped[RangeImage]) -> SweepPass:
    times_s = list(np.arange(-0.2, 1.4, 0.008))
    poses = [wrist_at(t) * WRIST_FROM_SCANNER for t in times_s]
    return SweepPass(scans=scans, times_s=times_s, base_from_scanner=poses)


def scan_of_the_plane(end_s: float) -> Stamped[RangeImage]:
    """Return a scan whose beams meet z = 1 m of the base from the scanner's pose at the time of each beam."""
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
    points = swept(*scans).points(LINE, 0.0)
    assert len(points) == 9 * LINE.width
    assert np.max(np.abs(points[:, 2] - PLANE_Z_M)) < 2e-4


def test_poses_of_another_time_would_bend_it() -> None:
    late = Stamped(value=scan_of_the_plane(0.5).value, host_time_s=0.6, sequence=1)
    assert np.max(np.abs(swept(late).points(LINE, 0.0)[:, 2] - PLANE_Z_M)) > 5e-3


def test_the_last_beam_ends_the_scan_and_the_scanner_turns_steadily() -> None:
    times_s = beam_times_s(2.0, LINE)
    assert times_s[-1] == 2.0
    assert times_s[0] == pytest.approx(2.0 - 0.1 * 90 / 360)


def test_unseen_beams_and_invalid_scans_give_no_points() -> None:
    depth_m = np.full((1, LINE.width), np.nan, np.float32)
    depth_m[0, 90] = 1.0
    one = Stamped(value=RangeImage(depth_m=depth_m), host_time_s=0.5, sequence=1)
    bad = Stamped(value=one.value, host_time_s=0.5, sequence=2, quality=Quality.INVALID, cause=Cause.OUT_OF_RANGE)
    assert swept(one).points(LINE, 0.0).shape == (1, 3)
    assert swept(bad).points(LINE, 0.0).shape == (0, 3)


def test_times_without_poses_are_refused() -> None:
    with pytest.raises(StaleReading, match="no arm pose"):
        swept().in_base(np.ones((1, 3)), np.array([5.0]))
    with pytest.raises(StaleReading, match="gap"):
        SweepPass(scans=[], times_s=[0.0, 0.5], base_from_scanner=[identity(), identity()]).in_base(
            np.ones((1, 3)), np.array([0.25])
        )


def test_only_lines_are_swept() -> None:
    with pytest.raises(InvalidRequest, match="lines"):
        swept(scan_of_the_plane(0.5)).points(IMAGE, 0.0)


def nodding_over_a_plane(
    seed: int, sigma_m: float, *, sign: float = 1.0, late_s: float = 0.0, mount: RigidTransform | None = None
) -> SweepPass:
    """Return a pass of a scanner that rotates at 0.4 rad/s before a tilted plane, with stamps that are late.

    `mount`: pose of the true scanner in the believed one.
    """
    scanner_from_true = identity() if mount is None else mount
    rng = np.random.default_rng(seed)

    def turned(time_s: Array) -> Rotation:
        return Rotation.from_rotvec(np.multiply.outer(sign * 0.4 * (1.25 - time_s), [1.0, 0.0, 0.0]))

    times_s = np.arange(0.0, 2.5, 0.008)
    poses = [RigidTransform.from_rotation(turned(t)) for t in times_s]
    scans = []
    for k, end_s in enumerate(np.arange(0.06, 2.45, 0.02)):
        angle = FINE.first_angle_rad + np.arange(FINE.width) * FINE.step_angle_rad
        beams = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
        turns = turned(beam_times_s(float(end_s), FINE))
        along = turns.apply(scanner_from_true.rotation.apply(beams))
        away_m = NORMAL @ POINT_M - turns.apply(scanner_from_true.translation) @ NORMAL
        range_m = away_m / (along @ NORMAL) + rng.normal(0.0, sigma_m, FINE.width)
        value = RangeImage(depth_m=np.array([range_m], np.float32))
        scans.append(Stamped(value=value, host_time_s=float(end_s) + late_s, sequence=k))
    return SweepPass(scans=scans, times_s=list(times_s), base_from_scanner=poses)


NORMAL = np.array([0.2, -0.1, -0.97]) / np.linalg.norm([0.2, -0.1, -0.97])
POINT_M = np.array([0.0, 0.0, 0.6])
FINE = replace(LINE, width=128, rate_hz=50.0, first_angle_rad=-0.4, step_angle_rad=0.8 / 127)


def test_rows_beside_an_empty_row_are_as_right_as_others() -> None:
    """A sweep of 120 lines leaves some of 128 rows empty; a slope that is not known there was 0.2 mm of their depth."""
    exact = nodding_over_a_plane(0, 0.0)
    image = image_from_sweep([exact], FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)
    off_m = (image.view.points(image.depth_m) - POINT_M) @ NORMAL
    assert np.nanmax(np.abs(np.nanmean(off_m, axis=1)[2:-2])) < 5e-5


@pytest.mark.parametrize("late_s", [None, 0.013, 0.06])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_image_of_a_sweep_gives_the_plane_within_its_covariance_however_late_its_stamps(
    seed: int, late_s: float | None
) -> None:
    """One pass with true stamps, or two with late ones: 13 ms turn the plane of one pass by 0.3 degrees."""
    passes = [nodding_over_a_plane(seed, 0.0006, late_s=late_s or 0.0)]
    if late_s is not None:
        passes.append(nodding_over_a_plane(seed + 10, 0.0006, sign=-1.0, late_s=late_s))
    image = image_from_sweep(passes, FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)
    depth_m, view = image.depth_m, image.view
    if late_s is not None:
        assert delay_between(passes[0], passes[1], FINE, identity(), view) == pytest.approx(late_s, abs=5e-4)
    assert np.isfinite(depth_m).mean() > (0.9 if late_s is None else 0.85)  # late stamps cost pixels at the ends
    fit = fit_plane_near(depth_m, view, point_m=POINT_M, normal=NORMAL, sigma_offset_m=0.01, sigma_angle_rad=0.02)
    feature = fit.feature
    sigma_m = np.sqrt(NORMAL @ feature.point_covariance @ NORMAL)
    assert abs(NORMAL @ (feature.point_m - POINT_M)) < 4.0 * sigma_m < 2e-4
    assert np.linalg.norm(np.cross(feature.direction, NORMAL)) < 4.0 * np.sqrt(np.trace(feature.direction_covariance))


def test_the_errors_of_a_mount_turn_the_swept_plane_as_far_as_its_covariance_says() -> None:
    """The plane is compared with that of a range camera on the same wrong mount; 0.2 mm and 0.05 degrees a sigma."""
    rng = np.random.default_rng(5)
    covariance = np.diag([4e-8] * 3 + [8.1e-7] * 3)
    squares = []
    for seed in range(12):
        view_from_true = perturbed(identity(), rng.multivariate_normal(np.zeros(6), covariance))
        swept = nodding_over_a_plane(seed, 0.0006, mount=view_from_true)
        image = image_from_sweep([swept], FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)
        # What the true camera sees in its own frame is taken for the believed frame.
        point_m, normal = view_from_true.inv().apply(POINT_M), view_from_true.rotation.inv().apply(NORMAL)
        feature = fit_plane_near(
            image.depth_m,
            image.view,
            point_m=point_m,
            normal=normal,
            swept=SweptErrors.of(UncertainPose(parent_from_child=identity(), covariance=covariance)),
        ).feature
        offset = normal @ (feature.point_m - point_m) / feature.sigma_point_m
        turn = feature.direction - normal
        tilt2 = turn @ np.linalg.pinv(feature.direction_covariance, rcond=1e-6) @ turn
        squares.append([offset**2, tilt2 / 2.0])
    assert np.all(np.mean(squares, axis=0) < 2.0)
    assert np.all(np.mean(squares, axis=0) > 0.4)


EXACT = UncertainPose(parent_from_child=identity(), covariance=np.zeros((6, 6)))


def test_two_different_delays_turn_the_swept_plane_as_far_as_its_covariance_says() -> None:
    """The delay that both passes share is estimated; the difference of the two shows in nothing."""
    rng, squares = np.random.default_rng(8), []
    for seed in range(5):
        first, second = (
            nodding_over_a_plane(seed + 50 * k, 2e-4, sign=1.0 - 2.0 * k, late_s=rng.normal(0.01, 5e-4)) for k in (0, 1)
        )
        image = image_from_sweep([first, second], FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)
        errors = SweptErrors.of(EXACT, apart_m=image.apart_m, rate_rad_per_s=0.4)
        feature = fit_plane_near(image.depth_m, image.view, point_m=POINT_M, normal=NORMAL, swept=errors).feature
        turn = feature.direction - NORMAL
        squares.append(turn @ np.linalg.pinv(feature.direction_covariance, rcond=1e-6) @ turn / 2.0)
    assert 0.1 < np.mean(squares) < 2.5


def test_passes_that_lie_apart_make_the_plane_as_uncertain_as_half_of_their_distance() -> None:
    first = nodding_over_a_plane(1, 1e-4)
    moved = nodding_over_a_plane(2, 1e-4, sign=-1.0)
    apart = RigidTransform.from_translation(4e-4 * NORMAL)
    turned = replace(moved, base_from_scanner=[apart * pose for pose in moved.base_from_scanner])
    passes = [first, turned]
    image = image_from_sweep(passes, FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)
    sigmas_m = [
        fit_plane_near(image.depth_m, image.view, point_m=POINT_M, normal=NORMAL, swept=errors).feature.sigma_point_m
        for errors in (SweptErrors.of(EXACT), SweptErrors.of(EXACT, apart_m=image.apart_m))
    ]
    assert sigmas_m[0] < 5e-5 and sigmas_m[1] == pytest.approx(2e-4, rel=0.2)
    biased = SweptErrors.of(EXACT, sigma_range_m=3e-3)
    feature = fit_plane_near(image.depth_m, image.view, point_m=POINT_M, normal=NORMAL, swept=biased).feature
    assert feature.sigma_point_m == pytest.approx(3e-3, rel=0.1), "an error of all distances is not averaged out"


def test_a_mount_that_needs_no_turn_adds_nothing() -> None:
    """Points that were seen in the pose of the view are shifted as a camera's; others by the turn of the error."""
    mount = SweptErrors.of(UncertainPose(parent_from_child=identity(), covariance=np.eye(6)))
    points_m, normal = np.array([[0.1, 0.0, 0.6], [0.0, 0.3, 0.5]]), np.array([0.0, 0.0, -1.0])
    moved = mount.distances(points_m, normal)
    assert np.abs(moved[0]).max() < 1e-12
    turn = Rotation.from_rotvec([np.arctan2(-0.3, 0.5), 0.0, 0.0]).as_matrix() - np.eye(3)
    assert moved[1, :3] == pytest.approx(normal @ turn)
    assert moved[1, 3:] == pytest.approx([normal @ np.cross(turn @ axis, points_m[1]) for axis in np.eye(3)])


def test_scans_before_the_first_pose_are_left_out_and_none_at_all_is_said() -> None:
    passes = [replace(nodding_over_a_plane(0, 0.0), times_s=[9.0, 9.1], base_from_scanner=[identity(), identity()])]
    for given in (passes, 2 * passes):
        with pytest.raises(NotFound, match="none of the points"):
            image_from_sweep(given, FINE, base_from_view=identity(), half_height_rad=0.45, swept_rad=0.9)


def test_an_inclined_surface_is_filled_in_where_it_is_measured_around_and_not_beyond_its_edge() -> None:
    view = PinholeSensor(width_px=40, height_px=30, fx_px=60.0, fy_px=60.0, cx_px=19.5, cy_px=14.5)
    rows, columns = np.mgrid[0:30, 5:25]
    x, y = (columns - view.cx_px) / view.fx_px, (rows - view.cy_px) / view.fy_px
    true_m = 1.0 / (1.6 + 0.8 * x - 0.3 * y)
    is_seen = np.random.default_rng(3).random(true_m.shape) < 0.8
    points = np.stack([x * true_m, y * true_m, true_m], axis=-1)[is_seen]
    depth_m = image_from_points(points, identity(), view)
    assert not np.isfinite(depth_m[:, :5]).any() and not np.isfinite(depth_m[:, 25:]).any()
    inside = depth_m[:, 5:25]
    assert np.isfinite(inside[1:-1, 1:-1]).mean() > 0.99
    assert np.nanmax(np.abs(inside - true_m)) < 2e-4, "a pixel is 10 mm wide, and the depth changes by 6 mm over it"
