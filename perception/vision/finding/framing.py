"""Check that an image shows exactly one panel, and shows it upright; otherwise it is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.errors import Ambiguous, NotFound
from hal.geometry import UncertainPose, transform
from hal.panel import Panel
from perception.vision.finding.plate import Plate, find_plate
from perception.vision.projection import CameraProjection, PanelProjection, PlateProjection, plate_by_corners
from perception.vision.registration.register import register

COARSE_WIDTH_PX = 160
LEAST_SHARE = 0.06  # of the image; on smaller plates no objects are visible
SECOND_SHARE = 0.3  # of the largest region's area; a second panel of this size could be the intended one
RECTANGLE_FILL = 0.85  # least share of its smallest enclosing rectangle that a plate's region fills
ASPECT_RATIO = 1.3  # factor by which the aspect of a plate seen obliquely may differ from its own
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
TURNED_LEAD = 0.15  # by which the share of the objects' edges must be larger for another orientation to be reported
SURELY_UPRIGHT = 0.75  # share of the edges from which a panel is upright; a mirrored, nearly symmetric panel has 0.58
UNMIRROR = "switch off the camera's mirroring, or mirror the picture back"
ASKEW: tuple[tuple[str, str, Callable[[Image], Image]], ...] = (
    ("mirrored", UNMIRROR, np.fliplr),
    ("mirrored and upside down", UNMIRROR, np.flipud),
)


def one_plate(
    gray: Image,
    plate_m: tuple[float, float],
    *,
    focal_px: float | None = None,
    corners_px: Sequence[tuple[float, float]] | None = None,
) -> Plate:
    """Return the plate of the one panel that fills the image, or whose four corners were clicked, in any order.

    Raises:
        NotFound: none does.
        Ambiguous: two panels are in view.
        InvalidRequest: the corners are not those of a convex quadrangle.
    """
    if corners_px is not None:
        return Plate(view=plate_by_corners(corners_px, plate_m), sides_seen=(True, True, True, True), is_sure=True)
    if _panels_in(gray, plate_m[0] / plate_m[1]) > 1:
        raise Ambiguous(
            "two panels are in view, and either may be meant",
            hint="show one panel: come closer, or cut the other one off the image",
        )
    plate = find_plate(gray, *plate_m, focal_px=focal_px)
    if plate is None:
        raise NotFound(
            "no plate fills the image", hint="take an overview of one panel, upright, with its border in view"
        )
    return plate


def check_upright(gray: Image, view: PanelProjection, panel: Panel) -> None:
    """Check that the panel does not fit better upside down or mirrored.

    Raises:
        NotFound: it does, so objects would be read at wrong positions.
    """
    upright, turned = (_objects_share(gray, v, panel) for v in (view, upside_down(view)))
    if turned > upright + TURNED_LEAD:
        raise _askew(panel, "upside down", turned, upright, hint="turn the image or the camera by 180 degrees")
    if upright > SURELY_UPRIGHT:
        return
    shares = [_righted_share(np.ascontiguousarray(righted(gray)), panel) for _, _, righted in ASKEW]
    best = int(np.argmax(shares))
    if shares[best] > upright + TURNED_LEAD:
        how, hint, _ = ASKEW[best]
        raise _askew(panel, how, shares[best], upright, hint=hint)


def _righted_share(gray: Image, panel: Panel) -> float:
    """Return `_objects_share` of an image in which the plate is searched for again; 0 if there is none."""
    plate = find_plate(gray, panel.width_m, panel.height_m)
    return 0.0 if plate is None else float(np.nan_to_num(_objects_share(gray, plate.view, panel)))


def _askew(panel: Panel, how: str, share: float, upright: float, *, hint: str) -> NotFound:
    """Return the error for a panel in another orientation, `how`."""
    edges = f"{share:.0%} of its objects' edges are found that way, {upright:.0%} upright"
    return NotFound(f"panel {panel.name!r} is {how} in this image: {edges}", hint=hint)


def upside_down(view: PanelProjection) -> PanelProjection:
    """Return the view of the same plate rotated by half a turn about its middle."""
    if isinstance(view, PlateProjection):
        return PlateProjection(
            px_from_plate=view.px_from_plate @ HALF_TURN, corners_m=view.corners_m, sigma_px=view.sigma_px
        )
    if isinstance(view, CameraProjection):
        pose = view.camera_from_panel
        turned = pose.parent_from_child * transform(HALF_TURN, np.zeros(3))
        return CameraProjection(
            intrinsics=view.intrinsics,
            camera_from_panel=UncertainPose(parent_from_child=turned, covariance=pose.covariance),
        )
    raise TypeError(f"no half turn of a {type(view).__name__}")


def _objects_share(gray: Image, view: PanelProjection, panel: Panel) -> float:
    """Return the share of the edges of the panel's objects that the image shows.

    NaN, for which all comparisons are false, if no object has edges.
    """
    shares = np.array([fit.edge_share for fit in register(gray, view, panel).objects.values()])
    shares = shares[np.isfinite(shares)]
    return float(shares.mean()) if len(shares) else float("nan")


def _panels_in(gray: Image, aspect: float) -> int:
    """Return the number of regions in the image that look like whole plates of that aspect and are of similar size."""
    shrink = max(1.0, gray.shape[1] / COARSE_WIDTH_PX)
    small = np.asarray(cv2.resize(gray, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA), np.uint8)
    smooth = cv2.medianBlur(small, 5)
    _, bright = cv2.threshold(smooth, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return max(_plates_among(np.asarray(mask, np.uint8), aspect) for mask in (bright, 255 - bright))


def _plates_among(mask: NDArray[np.uint8], aspect: float) -> int:
    """Return the number of outer contours of similar size that are plates; objects on a plate are holes in it."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlines = [np.asarray(contour, np.int32) for contour in contours]
    areas = np.array([cv2.contourArea(outline) for outline in outlines])
    least = max(SECOND_SHARE * areas.max(initial=0.0), LEAST_SHARE * mask.size)
    return sum(_is_plate(outlines[k], aspect) for k in np.flatnonzero(areas >= least))


def _is_plate(contour: NDArray[np.int32], aspect: float) -> bool:
    """Return whether a contour is nearly a rectangle of about that aspect."""
    (_, _), (a, b), angle = cv2.minAreaRect(contour)
    width, height = (a, b) if abs(angle) < 45 else (b, a)
    is_filled = cv2.contourArea(contour) >= RECTANGLE_FILL * a * b
    return bool(is_filled and 1 / ASPECT_RATIO < width / max(height, 1.0) / aspect < ASPECT_RATIO)
