"""Points from two or more views: against OpenCV and brute force, their covariance, and views that cannot tell."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion import PixelObservation, depth_before, fuse, triangulate, with_common_errors
from fusion.features import point
from fusion.triangulation import LEAST_PARALLAX_RAD
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project, undistort_pixels
from hal.errors import InvalidRequest, NotFound, NotObservable
from hal.geometry import UncertainPose, certain, perturbed, transform_rpy

LENS = CameraIntrinsics(
    width_px=640,
    height_px=480,
    fx_px=610.0,
    fy_px=606.0,
    cx_px=325.0,
    cy_px=236.0,
    distortion=(-0.12, 0.04, 0.0008, -0.0006, 0.0),
)
POINT = np.array([0.02, -0.03, 0.6])
LEFT = transform_rpy([-0.08, 0.0, 0.0], [0.02, 0.12, 0.01])
RIGHT = transform_rpy([0.09, 0.01, 0.02], [-0.03, -0.14, 0.05])
ABOVE = transform_rpy([0.0, -0.1, 0.01], [-0.15, 0.0, 1.5])
MOUNT = UncertainPose(
    parent_from_child=transform_rpy([0.0, -0.09, 0.06], [0.0, 0.1, 0.0]),
    covariance=np.diag([3e-4, 3e-4, 3e-4, 9e-4, 9e-4, 9e-4]) ** 2,
)
MOUNTS = {"camera": MOUNT}
SIGMA_PX = 0.4


def seen_from(camera: RigidTransform, at: Array = POINT, mount: RigidTransform | None = None) -> PixelObservation:
    """What a camera that should stand at `camera` sees of a point; its mount may differ from the calibrated one."""
    flange = camera * MOUNT.parent_from_child.inv()
    stands = flange * (MOUNT.parent_from_child if mount is None else mount)
    return PixelObservation(
        sensor="camera",
        base_from_flange=flange,
        name="rim",
        point_m=np.zeros(3),
        pixel_px=project(stands.inv().apply(at)[None], LENS)[0],
        covariance_px=SIGMA_PX**2 * np.eye(2),
        intrinsics=LENS,
    )


def shifted(seen: PixelObservation, by_px: Array) -> PixelObservation:
    return PixelObservation(**{f: getattr(seen, f) for f in seen.__slots__} | {"pixel_px": seen.pixel_px + by_px})


def brute_force(seen: list[PixelObservation]) -> Array:
    """The point by a general solver on the reprojection errors in pixels, through OpenCV's camera model."""
    K = np.array([[LENS.fx_px, 0, LENS.cx_px], [0, LENS.fy_px, LENS.cy_px], [0, 0, 1.0]])

    def errors(at: Array) -> Array:
        rows = []
        for one in seen:
            camera_from_base = (one.base_from_flange * MOUNT.parent_from_child).inv()
            turn = camera_from_base.rotation.as_rotvec()
            pixels, _ = cv2.projectPoints(at[None], turn, camera_from_base.translation, K, np.array(LENS.distortion))
            rows.append(pixels.ravel() - one.pixel_px)
        return np.concatenate(rows)

    return np.asarray(least_squares(errors, POINT + 0.02, xtol=1e-14, ftol=1e-14, gtol=1e-14).x)


@settings(max_examples=40, deadline=None)
@given(
    at=st.tuples(*[st.floats(-0.08, 0.08)] * 2, st.floats(0.4, 0.8)),
    left=st.tuples(*[st.floats(-0.1, 0.1)] * 6),
    right=st.tuples(*[st.floats(-0.1, 0.1)] * 6),
)
def test_two_exact_views_agree_with_opencv(
    at: tuple[float, ...], left: tuple[float, ...], right: tuple[float, ...]
) -> None:
    cameras = [perturbed(LEFT, left), perturbed(RIGHT, right)]
    seen = [seen_from(camera, np.array(at)) for camera in cameras]
    try:
        found = triangulate(seen, MOUNTS)
    except NotObservable:
        rays = [(camera.translation - at) / np.linalg.norm(camera.translation - at) for camera in cameras]
        assert np.linalg.norm(np.cross(*rays)) < np.sin(LEAST_PARALLAX_RAD) + 1e-9
        return
    K = np.array([[LENS.fx_px, 0, LENS.cx_px], [0, LENS.fy_px, LENS.cy_px], [0, 0, 1.0]])
    matrices = [K @ camera.inv().as_matrix()[:3] for camera in cameras]
    pixels = [undistort_pixels(one.pixel_px[None], LENS).T for one in seen]
    x, y, z, w = cv2.triangulatePoints(*matrices, *pixels).ravel()
    np.testing.assert_allclose(found.point_m, np.array([x, y, z]) / w, atol=1e-7)
    np.testing.assert_allclose(found.point_m, at, atol=1e-7)
    assert (found.degrees, found.chi_square) == (1, pytest.approx(0.0, abs=1e-6))


@pytest.mark.parametrize("seed", range(4))
def test_noisy_views_give_the_point_of_least_reprojection_error(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras = [LEFT, RIGHT, ABOVE, perturbed(ABOVE, rng.normal(scale=0.05, size=6))]
    seen = [shifted(seen_from(camera), rng.normal(scale=SIGMA_PX, size=2)) for camera in cameras]
    # weights differ from pixels by the lens's local stretch only
    exact = {"camera": certain(MOUNT.parent_from_child)}
    np.testing.assert_allclose(triangulate(seen, exact).point_m, brute_force(seen), atol=2e-5)


@pytest.mark.parametrize("cameras", [[LEFT, RIGHT], [LEFT, RIGHT, ABOVE]])
def test_the_covariance_holds_with_a_mount_and_a_lens_that_all_views_share(cameras: list[RigidTransform]) -> None:
    rng = np.random.default_rng(3)
    wrong = CameraIntrinsics(**{f: getattr(LENS, f) for f in LENS.__slots__} | {"fx_px": LENS.fx_px + 3.0})
    panel = certain(transform_rpy([0.0, 0.0, 0.6], [np.pi, 0.0, 0.0]))
    nees, chi_square, depth = [], [], []
    for _ in range(250):
        mount = perturbed(MOUNT.parent_from_child, rng.normal(size=6) * np.sqrt(np.diag(MOUNT.covariance)))
        lens_error = float(rng.normal())
        seen = []
        for camera in cameras:
            one = seen_from(camera, mount=mount)
            off = project(camera.inv().apply(POINT)[None], wrong)[0] - project(camera.inv().apply(POINT)[None], LENS)[0]
            seen.append(shifted(one, rng.normal(scale=SIGMA_PX, size=2) + lens_error * off))
        found = triangulate(seen, MOUNTS, lenses={"camera": [wrong]})
        e = found.point_m - POINT
        nees.append(e @ np.linalg.solve(found.covariance, e))
        chi_square.append(found.chi_square)
        depth.append(depth_before(panel, found, expected_m=0.0).chi_square)
    for values, degrees in ((nees, 3), (chi_square, 2 * len(cameras) - 3), (depth, 1)):
        low, high = chi2.ppf([0.0005, 0.9995], degrees * len(values))
        assert low < np.sum(values) < high


def test_a_shared_mount_widens_the_point() -> None:
    seen = [seen_from(camera) for camera in (LEFT, RIGHT, ABOVE)]
    exact = {"camera": certain(MOUNT.parent_from_child)}
    assert np.trace(triangulate(seen, MOUNTS).covariance) > 1.3 * np.trace(triangulate(seen, exact).covariance)


def test_depth_counts_from_the_plate_along_its_normal_and_contradicts_beyond_chance() -> None:
    pose = transform_rpy([0.1, -0.2, 0.605], [np.pi - 0.1, 0.05, 0.4])
    panel = UncertainPose(parent_from_child=pose, covariance=np.diag([1e-4] * 3 + [1e-3] * 3) ** 2)
    found = triangulate([seen_from(camera) for camera in (LEFT, RIGHT, ABOVE)], MOUNTS)
    true_m = float(pose.inv().apply(POINT)[2])
    depth = depth_before(panel, found, expected_m=true_m)
    assert depth.depth_m == pytest.approx(true_m, abs=1e-9) and not depth.contradicts
    by_differences = []
    for axis in range(6):  # the derivative by the panel's pose
        delta = 1e-6 * np.eye(6)[axis]
        moved = depth_before(certain(perturbed(pose, delta)), found, expected_m=0.0).depth_m
        by_differences.append((moved - depth.depth_m) / 1e-6)
    normal = pose.rotation.as_matrix()[:, 2]
    variance = np.array(by_differences) ** 2 @ np.diag(panel.covariance) + normal @ found.covariance @ normal
    assert depth.sigma_m**2 == pytest.approx(variance, rel=1e-4)
    assert not depth_before(panel, found, expected_m=true_m + 3.8 * depth.sigma_m).contradicts
    assert depth_before(panel, found, expected_m=true_m + 4.0 * depth.sigma_m).contradicts
    assert not depth_before(panel, found, expected_m=true_m + 0.02, expected_sigma_m=0.01).contradicts


def test_common_errors_are_kept_whole_by_the_mean_of_the_views() -> None:
    views = [seen_from(camera) for camera in (LEFT, RIGHT, ABOVE)]
    common = np.diag([0.5, 2.0])
    widened = with_common_errors(views, [common] * 3)
    for one in widened:
        np.testing.assert_allclose(one.covariance_px, SIGMA_PX**2 * np.eye(2) + 3 * common)


def test_points_by_two_views_are_measurements_of_class_one() -> None:
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.08, 0.0], [0.05, 0.06, 0.03]])
    pose = transform_rpy([0.0, -0.03, 0.62], [0.2, -0.1, 0.5])
    made = []
    for place in places:
        found = triangulate([seen_from(camera, pose.apply(place)) for camera in (LEFT, RIGHT)], MOUNTS)
        made.append(found.measurement(point(place)))
    assert {one.cls.words for one in made} == {"point-point"}
    fused = fuse(made)
    np.testing.assert_allclose(fused.pose.as_matrix(), pose.as_matrix(), atol=1e-6)


def test_parallel_rays_leave_the_depth_free() -> None:
    with pytest.raises(NotObservable, match="depth"):
        triangulate([seen_from(LEFT), seen_from(perturbed(LEFT, [1e-3, 0, 0, 0, 0, 0]))], MOUNTS)


def test_two_different_things_are_not_one_point() -> None:
    with pytest.raises(NotFound, match="one point"):
        triangulate([seen_from(LEFT), shifted(seen_from(RIGHT), np.array([0.0, 15.0]))], MOUNTS)


def test_rays_that_meet_behind_a_camera_see_different_things() -> None:
    with pytest.raises(NotFound, match="behind"):
        triangulate([shifted(seen_from(LEFT), np.array([-250.0, 0.0])), seen_from(RIGHT)], MOUNTS)


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="two views"):
        triangulate([seen_from(LEFT)], MOUNTS)
    with pytest.raises(InvalidRequest, match="rim is not finite"):
        triangulate([seen_from(LEFT), shifted(seen_from(RIGHT), np.array([np.nan, 0.0]))], MOUNTS)
