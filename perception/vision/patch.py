"""Rectified pictures of single objects: fronto-parallel, with known pixels per metre. Every reader works on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array, Image
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.projection import PanelProjection, homography

OVERSAMPLING = 1.5  # rectified pixels per image pixel; preserves detail in the second interpolation
MAX_SIDE_PX = 320  # largest side of a patch
HEIGHT_STEP_M = 0.01  # difference in height by which parallax and growth are measured
BEND_NODES = 9  # nodes along a side of the grid on which the lens distortion over a patch is known; it is smooth
LEAST_BEND_PX = 0.05  # a smaller deviation from a homography is neglected

#: Corners of a patch clockwise from the upper left, and nodes of that grid, in half sizes from the middle.
CORNERS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
NODES = np.array([[x, y] for y in np.linspace(1.0, -1.0, BEND_NODES) for x in np.linspace(-1.0, 1.0, BEND_NODES)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """Rectified picture of an object, as seen from straight ahead.

    Object frame: origin at the object's middle, x right, y up, z towards the viewer, metres. The patch shows the plane
    `plane_z_m` undistorted; a point `dz` above it appears shifted by `parallax_px_per_m * dz`.

    Attributes:
        gray: (H, W) uint8.
        colour: (H, W, 3) RGB, or None for a gray camera.
        inside: (H, W) bool, False where the patch is outside the image.
        px_per_m: patch pixels per metre.
        image_px_per_m: original image pixels per metre, the true resolution.
        origin_px: (2,) u and v of the object's middle at `plane_z_m`.
        parallax_px_per_m: (2,) shift in the patch per metre of height.
        growth_per_m: relative magnification per metre of height, the inverse of the camera's distance; 0 for a
        homography.
        is_placed: whether the object is where the patch shows it but for its building tolerance, because the plate's border
        was seen.
    """

    gray: Image
    colour: Image | None
    inside: NDArray[np.bool_]
    px_per_m: float
    image_px_per_m: float
    origin_px: Array
    parallax_px_per_m: Array
    growth_per_m: float
    plane_z_m: float
    is_placed: bool = False

    def pixel_of(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return the patch coordinates (u, v) of object points; `z_m` is the patch's plane by default."""
        dz = np.asarray(0.0 if z_m is None else np.asarray(z_m, float) - self.plane_z_m)
        scale = self.px_per_m * (1.0 + self.growth_per_m * dz)
        u = self.origin_px[0] + scale * np.asarray(x_m, float) + self.parallax_px_per_m[0] * dz
        v = self.origin_px[1] - scale * np.asarray(y_m, float) + self.parallax_px_per_m[1] * dz
        return u, v

    def sample(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> NDArray[np.float32]:
        """Return gray values (bilinear, float32) at object points of any common shape of one or two dimensions."""
        u, v = self.pixel_of(x_m, y_m, z_m)
        return sample_at(self.gray, u, v)

    def seen(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> float:
        """Return the share of the object points that lie inside the image and are not saturated."""
        u, v = self.pixel_of(x_m, y_m, z_m)
        good = (self.inside & (self.gray < WHITE_LEVEL)).astype(np.uint8)
        return float(sample_at(good, u, v).mean())


def sample_at(image: NDArray[Any], u: Array, v: Array, *, outside: float | None = None) -> NDArray[np.float32]:
    """Return bilinear values at coordinates of one or two dimensions; the border repeats unless `outside` is given."""
    u32, v32 = np.atleast_2d(u).astype(np.float32), np.atleast_2d(v).astype(np.float32)
    border = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    values = cv2.remap(
        image.astype(np.float32, copy=False), u32, v32, cv2.INTER_LINEAR, borderMode=border, borderValue=outside or 0.0
    )
    return np.asarray(values.reshape(np.shape(u)), np.float32)


def rectify(
    image: Image,
    view: PanelProjection,
    centre_m: ArrayLike,
    *,
    half_width_m: float,
    half_height_m: float,
    plane_z_m: float = 0.0,
    shift_px: ArrayLike = (0.0, 0.0),
    gray: Image | None = None,
) -> Patch:
    """Return the patch around `centre_m` (x, y on the plate) with the given half sizes, at height `plane_z_m`.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        shift_px: (2,) shift found by the object's own registration; it is added to the projected points.
        gray: the gray version of `image`, if it is already known.
    """
    half = np.array([half_width_m, half_height_m])
    places = np.vstack([CORNERS, CORNERS, NODES]) * half + np.asarray(centre_m, float)
    heights = np.full(len(places), plane_z_m)
    heights[4:8] += HEIGHT_STEP_M
    seen_px = view.project(np.column_stack([places, heights])) + np.asarray(shift_px, float)
    corners_px, nodes_px = seen_px[:4], seen_px[8:]
    image_px_per_m = float(np.sqrt(_area(corners_px) / (4 * half.prod())))
    px_per_m = min(OVERSAMPLING * image_px_per_m, MAX_SIDE_PX / (2 * float(half.max())))
    width, height = (round(2 * side * px_per_m) + 1 for side in (half_width_m, half_height_m))
    middle = half * px_per_m
    patch_from_image = homography(corners_px, _in_patch(CORNERS, middle))
    image_from_patch = np.asarray(np.linalg.inv(patch_from_image), float)
    gray_image = image if image.ndim == 2 else gray if gray is not None else as_gray(image)
    low, high = _apply(patch_from_image, seen_px[:8]).reshape(2, 4, 2)
    spread = [float(np.linalg.norm(at - at.mean(axis=0), axis=1).sum()) for at in (low, high)]
    bend_px = _bend(nodes_px - _apply(image_from_patch, _in_patch(NODES, middle)))
    size = (width, height)
    return Patch(
        gray=_warp(gray_image, patch_from_image, size, bend_px),
        colour=_warp(image, patch_from_image, size, bend_px) if image.ndim == 3 else None,
        inside=_inside(gray_image.shape, patch_from_image, image_from_patch, size),
        px_per_m=px_per_m,
        image_px_per_m=image_px_per_m,
        origin_px=middle,
        parallax_px_per_m=(high - low).mean(axis=0) / HEIGHT_STEP_M,
        growth_per_m=(spread[1] / spread[0] - 1.0) / HEIGHT_STEP_M,
        plane_z_m=plane_z_m,
    )


def _in_patch(places: Array, middle_px: Array) -> Array:
    """Return the patch coordinates (N, 2) of points given in half sizes from the middle, y up."""
    return np.asarray(middle_px + places * np.array([1.0, -1.0]) * middle_px, float)


def _bend(missed_px: Array) -> NDArray[np.float32] | None:
    """Return the deviation from a homography through the corners at the `NODES`, image px, as a grid.

    None if it is small. Near the border of a view, distortion of k1 = -0.08 bends a slider's track by more than a
    pixel.
    """
    if not np.isfinite(missed_px).all() or np.abs(missed_px).max() < LEAST_BEND_PX:
        return None
    return missed_px.reshape(BEND_NODES, BEND_NODES, 2).astype(np.float32)


def _warp(image: Image, patch_from_image: Array, size: tuple[int, int], bend_px: NDArray[np.float32] | None) -> Image:
    """Return the image as a patch of `size`, through the homography and the deviation from it."""
    if bend_px is None:
        flags = cv2.INTER_LINEAR
        return np.asarray(
            cv2.warpPerspective(image, patch_from_image, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
        )
    u, v = _places(patch_from_image, size, bend_px)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _places(
    patch_from_image: Array, size: tuple[int, int], bend_px: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the image coordinates u and v, each (H, W), of every patch pixel: homography plus deviation from it."""
    to_nodes = np.array([[(BEND_NODES - 1) / (size[0] - 1), 0.0, 0.0], [0.0, (BEND_NODES - 1) / (size[1] - 1), 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    bend = cv2.warpAffine(bend_px, to_nodes, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    m = np.linalg.inv(patch_from_image)
    x, y = np.arange(size[0]), np.arange(size[1])[:, None]
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / depth + bend[:, :, 0]
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / depth + bend[:, :, 1]
    return u.astype(np.float32), v.astype(np.float32)


def _inside(
    shape: tuple[int, ...], patch_from_image: Array, image_from_patch: Array, size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return which pixels of the patch (H, W) lie inside the image."""
    corners = np.array([[0, 0], [size[0] - 1, 0], [size[0] - 1, size[1] - 1], [0, size[1] - 1]], float)
    back = _apply(image_from_patch, corners)
    if (back >= 0).all() and (back[:, 0] <= shape[1] - 1).all() and (back[:, 1] <= shape[0] - 1).all():
        return np.ones((size[1], size[0]), bool)
    ones = np.ones(shape[:2], np.uint8)
    return np.asarray(cv2.warpPerspective(ones, patch_from_image, size, flags=cv2.INTER_NEAREST)) > 0


def _apply(h: Array, points: Array) -> Array:
    """Return the points (N, 2) transformed by a homography."""
    u = np.column_stack([points, np.ones(len(points))]) @ h.T
    return np.asarray(u[:, :2] / u[:, 2:])


def _area(quad: Array) -> float:
    """Return the area of a quadrangle."""
    x, y = quad.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
