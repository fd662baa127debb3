"""Pose of the panel from the outline of its plate, which must stand out against what is behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size
from hal.errors import NotFound
from hal.geometry import UncertainPose
from hal.panel import Panel
from perception.vision.finding.framing import check_upright, one_plate
from perception.vision.image import as_gray
from perception.vision.lights.panel_finder import MODEL_SIGMA_PX, PanelPrior
from perception.vision.panel_ways.corners import MeasuredCorners, measure_corners
from perception.vision.panel_ways.points import pose_from_points
from perception.vision.panel_ways.sighting import PanelSighting, PanelWay, check_fit, sighting
from perception.vision.projection import CameraProjection
from perception.vision.registration.register import EdgeImage, edge_image

FOUND_SIGMA_PX = 3.0  # of a corner as the search for the plate gives it, which knows no lens distortion
WINDOWS_PX = (6.0, 3.0, 2.0)  # half lengths of the search for the sides
EDGE_BIAS_PX = 0.12  # offset of a whole side: shade of the edge, blur, and the background's own brightness
WALL_SHARE = 0.3  # share of the visible width of the plate's narrow side by which its edge may be displaced
CORNERS = ("upper_left_corner", "upper_right_corner", "lower_right_corner", "lower_left_corner")


def find_by_outline(
    image: NDArray[Any],
    panel: Panel,
    intrinsics: CameraIntrinsics,
    *,
    prior: PanelPrior,
    lens_rms_px: float = MODEL_SIGMA_PX,
) -> PanelSighting:
    """Find the panel by the four sides of its plate, all of which must be in view.

    A plate looks the same upside down: it is expected upright within 45 degrees, and refused if its objects look more
    like the panel turned by half a turn.

    Raises:
        NotFound: no plate stands out, a side is out of view, or the prior does not allow the pose.
        Ambiguous: two plates are in view, or two poses fit equally well.
        WrongMark: the four sides do not fit a plate of the size in the panel file.
        InvalidRequest: not an image, or of another size than the calibration.
    """
    gray = as_gray(image)
    check_size(gray, intrinsics)
    plate = one_plate(gray, (panel.width_m, panel.height_m), focal_px=intrinsics.fx_px)
    corners_m = plate_corners_m(panel)
    start = pose_from_points(corners_m, plate.view.project(corners_m), FOUND_SIGMA_PX**2 * np.eye(8), intrinsics).poses[
        0
    ]
    measured = _measured(edge_image(gray), start, corners_m, intrinsics, panel)
    noise = measured.covariance_px + lens_rms_px**2 * np.eye(2)
    pixel_m = intrinsics.fx_px / float(start.parent_from_child.translation[2])
    back = np.linalg.inv(measured.edge_normals_px)
    built = (panel.tolerances.edge_m * pixel_m) ** 2 * back @ back.transpose(0, 2, 1)
    found = pose_from_points(corners_m, measured.points_px, block_diag(*(noise + built)), intrinsics)
    check_fit(
        found, 4, f"the outline does not fit a plate of {panel.width_m:g} x {panel.height_m:g} m",
        hint="measure width_m and height_m of the plate again, or state tolerances.edge_m; check the lens calibration",
    )  # fmt: skip
    seen = sighting(PanelWay.OUTLINE, CORNERS, corners_m, measured.points_px, (noise, built), found, prior)
    check_upright(gray, CameraProjection(intrinsics=intrinsics, camera_from_panel=seen.camera_from_panel), panel)
    return seen


def plate_corners_m(panel: Panel) -> Array:
    """Return the corners (4, 3) of the plate's front face, upper left first and clockwise."""
    w, h = panel.width_m / 2, panel.height_m / 2
    return np.array([[-w, h, 0.0], [w, h, 0.0], [w, -h, 0.0], [-w, -h, 0.0]])


def _measured(
    edges: EdgeImage, pose: UncertainPose, corners_m: Array, intrinsics: CameraIntrinsics, panel: Panel
) -> MeasuredCorners:
    """Return the corners, measured in windows of decreasing size.

    Raises:
        NotFound: a side is not seen.
    """
    measured: MeasuredCorners | None = None
    for window_px in WINDOWS_PX:
        view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
        bias_px = _bias_px(view, corners_m, panel)
        measured = measure_corners(edges, view, corners_m, window_px, bias_px)
        if measured is None:
            raise NotFound(
                f"the plate of panel {panel.name!r} was seen, but not all of its four sides",
                hint="show the whole plate before a background that differs from it, or put tags on the panel",
            )
        pose = pose_from_points(
            corners_m, measured.points_px, block_diag(*(measured.covariance_px + 0.01 * np.eye(2))), intrinsics
        ).poses[0]
    assert measured is not None  # noqa: S101 - there are windows
    return measured


def _bias_px(view: CameraProjection, corners_m: Array, panel: Panel) -> Array:
    """Return one sigma (4,) of each side's offset; the narrow side of a plate that is seen obliquely adds to it."""
    front = view.project(corners_m)
    back = view.project(corners_m - [0.0, 0.0, panel.thickness_m])
    middle = front.mean(axis=0)
    bias = np.empty(4)
    for k in range(4):
        along = front[(k + 1) % 4] - front[k]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        normal *= np.sign(normal @ (front[k] - middle)) or 1.0
        wall_px = max(0.0, float(normal @ (back[k] - front[k] + back[(k + 1) % 4] - front[(k + 1) % 4])) / 2)
        bias[k] = np.hypot(EDGE_BIAS_PX, WALL_SHARE * wall_px)
    return bias
