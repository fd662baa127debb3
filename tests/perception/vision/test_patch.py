"""Rectified patches have the image's value at the projection of every point, whatever the lens."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose
from perception.vision.patch import rectify
from perception.vision.projection import CameraProjection, PlateProjection

SIZE = (480, 640)
HALF_M, TOP_M = (0.07, 0.03), 0.016


def camera_view(k1: float, *, beside_m: float) -> CameraProjection:
    """Return a camera 0.34 m in front of the plate and `beside_m` to the right of the object."""
    lens = CameraIntrinsics(
        width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5, distortion=(k1, 0, 0, 0, 0)
    )
    turn = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    panel_from_camera = RigidTransform.from_components([beside_m, 0.02, 0.34], turn)
    pose = UncertainPose(parent_from_child=panel_from_camera.inv(), covariance=1e-8 * np.eye(6))
    return CameraProjection(intrinsics=lens, camera_from_panel=pose)


def ramp(along: int, middle_px: np.ndarray) -> np.ndarray:
    """Return an image whose gray encodes the column (`along` 0) or row (1): 128 in the centre, one level per pixel."""
    places = np.indices(SIZE)[1 - along]
    return np.asarray(np.clip(places - np.round(middle_px[along]) + 128, 0, 255), np.uint8)


def places_px(view: CameraProjection, *, shift_px: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) image positions of points of an object, by patches of two ramps and by the projection."""
    width_m, height_m = HALF_M
    ways = np.meshgrid(np.linspace(-0.9, 0.9, 7) * width_m, np.linspace(-0.9, 0.9, 5) * height_m)
    x, y = (way.ravel() for way in ways)
    truly = view.project(np.column_stack([x, y, np.full(len(x), TOP_M)])) + np.array(shift_px)
    middle = truly.mean(axis=0)
    patches = [
        rectify(
            ramp(along, middle), view, (0.0, 0.0), half_width_m=width_m, half_height_m=height_m, plane_z_m=TOP_M,
            shift_px=shift_px,
        )
        for along in (0, 1)
    ]  # fmt: skip
    return np.column_stack([patch.sample(x, y) for patch in patches]) - 128 + np.round(middle), truly


@pytest.mark.parametrize("k1", [0.0, -0.08, -0.25, 0.1])
@pytest.mark.parametrize("beside_m", [-0.12, 0.0, 0.12])
def test_every_point_of_a_patch_is_taken_from_where_the_lens_puts_it(k1: float, beside_m: float) -> None:
    seen, truly = places_px(camera_view(k1, beside_m=beside_m), shift_px=(0.4, -0.7))
    assert np.abs(seen - truly).max() < 0.75  # rounding by half a gray level, and two interpolations
    assert np.abs((seen - truly).mean(axis=0)).max() < 0.3


def test_a_homography_alone_would_miss_by_more_than_a_pixel() -> None:
    view = camera_view(-0.25, beside_m=0.12)
    corners_m = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * np.array(HALF_M)
    corners = np.column_stack([corners_m, np.full(4, TOP_M)])
    straight = PlateProjection(px_from_plate=np.eye(3), corners_m=corners_m)
    straight = straight.moved((view.project(corners) - corners_m).ravel())
    middle = np.array([[0.0, 0.0, TOP_M]])
    assert np.linalg.norm(straight.project(middle) - view.project(middle)) > 1.0
