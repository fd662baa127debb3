"""Where an image shows the rims of the panel's objects, for measuring their places in space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.geometry import UncertainPose
from hal.panel import Panel, PanelObject
from perception.vision.image import as_gray
from perception.vision.projection import CameraProjection, PanelProjection
from perception.vision.registration.outline import edges_of
from perception.vision.registration.register import EdgeImage, edge_image, fit_object, register

LEAST_SHARE = 0.7  # of a rim's edges: half hidden by a cable it would be measured beside its middle
ELSEWHERE_SHARE = 0.9  # the same at a height that the panel file does not state
OTHER_HEIGHTS_M = 0.006 * np.array([1, -1, 2, -2, 3, -3, 4, -4])  # 6 mm move an edge by less than its search window
STEP_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RimView:
    """The middle of an object's rim in one image.

    Attributes:
        name: of the object.
        point_m: (3,) the middle in the panel file, panel frame.
        pixel_px: (2,) its image, as the edges of the rim show it.
        covariance_px: (2, 2) of `pixel_px`, px^2.
        built_covariance_px: (2, 2) px^2 that the tolerances of the built panel, and an uncertain height of the rim, add
            between `pixel_px` and the image of `point_m`. It is common to all views of the object.
    """

    name: str
    point_m: Array
    pixel_px: Array
    covariance_px: Array
    built_covariance_px: Array


def find_rims(
    image: NDArray[Any], intrinsics: CameraIntrinsics, camera_from_panel: UncertainPose, panel: Panel
) -> tuple[RimView, ...]:
    """Find the rims that are in view and hidden by nothing; kinds without a rim have none.

    A rim that is not found at the height of the panel file is looked for at other heights.

    Args:
        image: (H, W) gray or (H, W, 3) RGB, uint8, not undistorted.
        intrinsics: of the camera at this resolution.
        camera_from_panel: pose with an error of at most a few pixels.
    """
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=camera_from_panel)
    gray = as_gray(image)
    registered = register(gray, view, panel).view
    edges = edge_image(gray)
    views = (_rim_view(edges, registered, one, panel.tolerances.position_m) for one in panel.objects)
    return tuple(view for view in views if view is not None)


def _rim_view(image: EdgeImage, view: PanelProjection, panel_object: PanelObject, built_m: float) -> RimView | None:
    """Return where the image shows an object's rim; None if it does not."""
    rim, outline = panel_object.rim, edges_of(panel_object)
    if rim is None or outline is None:
        return None
    for off_m in (0.0, *OTHER_HEIGHTS_M):
        off = np.array([0.0, 0.0, off_m])
        fit = fit_object(image, view, replace(outline, points_m=outline.points_m + off), built_m)
        if np.isnan(fit.edge_share):
            return None  # out of view
        if fit.measured_px is None or fit.covariance_px is None:
            continue
        if fit.edge_share < (ELSEWHERE_SHARE if off_m else LEAST_SHARE):
            continue
        point = np.array([*panel_object.position_m, rim.above_plate_m])
        at = view.project(np.vstack([point + off, point + STEP_M * np.vstack([np.zeros(3), np.eye(3)])]))
        by_place = (at[2:] - at[1]).T / STEP_M
        return RimView(
            name=panel_object.name,
            point_m=point,
            pixel_px=at[0] + fit.measured_px,
            covariance_px=fit.covariance_px,
            built_covariance_px=(by_place * np.array([built_m, built_m, rim.above_sigma_m]) ** 2) @ by_place.T,
        )
    return None
