"""Pose of the panel from printed AprilTags: found by OpenCV, their corners measured along their sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from hal.arrays import Array, Image
from hal.calibration import CameraIntrinsics
from hal.camera_model import check_size
from hal.errors import Ambiguous, NotFound
from hal.panel import Panel, Tag
from perception.vision.image import as_gray
from perception.vision.lights.panel_finder import MODEL_SIGMA_PX, PanelPrior
from perception.vision.panel_ways.corners import measure_corners
from perception.vision.panel_ways.points import PointsPose, pose_from_points
from perception.vision.panel_ways.sighting import PanelSighting, PanelWay, check_fit, fits, sighting
from perception.vision.projection import CameraProjection
from perception.vision.registration.register import edge_image

DETECTED_SIGMA_PX = 0.7  # of a corner as OpenCV gives it
WINDOWS_PX = (2.0, 1.5)  # half lengths of the search for a tag's sides, which must not reach the cells of its code
EDGE_BIAS_PX = 0.08  # offset of a whole side by blur and by the shade of the print
LEAST_PERIMETER = 0.02  # of the longer image side; a tag must have about 3 px per cell to be read


def find_by_tags(
    image: NDArray[Any],
    panel: Panel,
    intrinsics: CameraIntrinsics,
    *,
    prior: PanelPrior,
    lens_rms_px: float = MODEL_SIGMA_PX,
) -> PanelSighting:
    """Find the panel by those of its tags that are in view; one is enough, and two far apart are much more exact.

    Raises:
        NotFound: no tag of the panel file is visible, or the prior does not allow the pose.
        Ambiguous: a tag is visible twice, or two poses fit equally well.
        WrongMark: the tags are not where the panel file has them; names the worst one if there are three.
        InvalidRequest: not an image, or of another size than the calibration.
    """
    gray = as_gray(image)
    check_size(gray, intrinsics)
    seen = _visible(gray, panel.tags)
    if not seen:
        known = ", ".join(f"{tag.family} id {tag.id}" for tag in panel.tags) or "the panel file has none"
        raise NotFound(
            f"no tag of panel {panel.name!r} is visible ({known})",
            hint="uncover the tags, come nearer (3 px per cell of the code are needed), and check family and id",
        )
    tags = list(seen)
    corners_px, noise = _measured(gray, seen, intrinsics)
    noise += lens_rms_px**2 * np.eye(2)
    found = _fit(tags, corners_px, noise, panel, intrinsics)
    what = f"{len(tags)} tags were seen, but not where the panel file has them"
    if len(tags) > 2 and not fits(found, 4 * len(tags)):
        what += f"; without {_worst(tags, corners_px, noise, panel, intrinsics).name} the others fit best"
    check_fit(
        found, 4 * len(tags), what,
        hint="measure place, size_m and angle_rad of the tags again (black square only), and check the lens calibration",
    )  # fmt: skip
    names = tuple(f"{tag.name}_corner_{k}" for tag in tags for k in range(4))
    pixel_m = intrinsics.fx_px / max(float(found.poses[0].parent_from_child.translation[2]), 0.05)
    place_px = 2.0 * panel.tolerances.tag_m * pixel_m  # twice, because the error is common to the tag's four corners
    built = np.tile(place_px**2 * np.eye(2), (len(names), 1, 1))
    seen_px, noise = corners_px.reshape(-1, 2), noise.reshape(-1, 2, 2)
    return sighting(PanelWay.TAGS, names, _corners_m(tags), seen_px, (noise, built), found, prior)


def _visible(gray: Image, tags: Sequence[Tag]) -> dict[Tag, Array]:
    """Return the tags in view with their corners (4, 2) as OpenCV gives them.

    Raises:
        Ambiguous: one is in view twice.
    """
    seen: dict[Tag, Array] = {}
    for family in sorted({tag.family for tag in tags}):
        known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
        parameters = cv2.aruco.DetectorParameters()
        parameters.minMarkerPerimeterRate = LEAST_PERIMETER
        corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(gray)
        places: dict[int, list[Array]] = {}
        for number, place in zip([] if ids is None else [int(k) for k in ids.ravel()], corners, strict=True):
            places.setdefault(number, []).append(np.asarray(place, float).reshape(4, 2))
        for tag in (tag for tag in tags if tag.family == family and tag.id in places):
            if len(places[tag.id]) > 1:
                raise Ambiguous(
                    f"tag {family} id {tag.id} is in view {len(places[tag.id])} times",
                    hint="print each tag once; cover the one that is not on the panel",
                )
            seen[tag] = places[tag.id][0]
    return seen


def _corners_m(tags: Sequence[Tag]) -> Array:
    return np.array([corner for tag in tags for corner in tag.corners_m])


def _measured(gray: Image, seen: dict[Tag, Array], intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """Return the corners (T, 4, 2) measured along the sides, with their covariances (T, 4, 2, 2).

    A tag whose sides cannot be measured keeps the corners that OpenCV gave.
    """
    corners_px = np.stack(list(seen.values()))
    noise = np.tile(DETECTED_SIGMA_PX**2 * np.eye(2), (len(seen), 4, 1, 1))
    edges = edge_image(gray)
    for window_px in WINDOWS_PX:
        covariance = block_diag(*noise.reshape(-1, 2, 2))
        for k, tag in enumerate(seen):  # each tag by its own pose, so that its place in the file does not matter
            own_m = np.array(tag.corners_m)
            part = covariance[8 * k : 8 * k + 8, 8 * k : 8 * k + 8]
            view = CameraProjection(
                intrinsics=intrinsics,
                camera_from_panel=pose_from_points(own_m, corners_px[k], part, intrinsics).poses[0],
            )
            measured = measure_corners(edges, view, own_m, window_px, np.full(4, EDGE_BIAS_PX))
            if measured is not None:
                corners_px[k], noise[k] = measured.points_px, measured.covariance_px
    return corners_px, noise


def _fit(
    tags: Sequence[Tag], corners_px: Array, noise: Array, panel: Panel, intrinsics: CameraIntrinsics
) -> PointsPose:
    """Return the pose by all corners (T, 4, 2) px; an error of a tag's place is common to its four corners."""
    corners_m = _corners_m(tags)
    spread_m = np.linalg.norm(np.ptp(corners_m, axis=0))
    spread_px = np.linalg.norm(np.ptp(corners_px.reshape(-1, 2), axis=0))
    distance_m = intrinsics.fx_px * spread_m / max(float(spread_px), 1.0)
    place_px = panel.tolerances.tag_m * intrinsics.fx_px / max(float(distance_m), 0.05)
    shift = np.tile(np.eye(2), (4, 1))
    blocks = []
    for tag, places, own in zip(tags, corners_px, noise, strict=True):
        u, v = (places - places.mean(axis=0)).T
        turn = np.column_stack([-v, u]).reshape(8, 1)
        turn_sigma = 0.5 * panel.tolerances.tag_m / tag.size_m  # a tag is turned by up to its place error over its side
        blocks.append(block_diag(*own) + place_px**2 * shift @ shift.T + turn_sigma**2 * turn @ turn.T)
    return pose_from_points(corners_m, corners_px.reshape(-1, 2), block_diag(*blocks), intrinsics)


def _worst(tags: Sequence[Tag], corners_px: Array, noise: Array, panel: Panel, intrinsics: CameraIntrinsics) -> Tag:
    """Return the tag without which the others fit best."""
    others = [[j for j in range(len(tags)) if j != k] for k in range(len(tags))]
    rest = [_fit([tags[j] for j in some], corners_px[some], noise[some], panel, intrinsics) for some in others]
    return tags[int(np.argmin([found.chi_square for found in rest]))]
