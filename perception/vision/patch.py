"""Rectified pictures of single objects: fronto-parallel, with known metres per pixel. Every reader works on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hal.arrays import Array, Image
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.projection import PanelProjection, homography

OVERSAMPLING = 1.5  # rectified pixels per image pixel: keeps detail through the second interpolation
MAX_SIDE_PX = 320
HEIGHT_STEP_M = 0.01
BEND_NODES = 9  # a side of the grid that the lens's bend over a patch is known at; it is smooth
LEAST_BEND_PX = 0.05

#: Corners of a patch clockwise from the upper left, and the grid that the bend is known at, in half sizes from its middle.
CORNERS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
NODES = np.array([[x, y] for y in np.linspace(1.0, -1.0, BEND_NODES) for x in np.linspace(-1.0, 1.0, BEND_NODES)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """An object seen from straight ahead.

    Object frame: origin at the object's middle, x right, y up, z towards the viewer, metres. The patch shows the plane
    `plane_z_m` undistorted; what stands `dz` above it appears shifted by `parallax_px_per_m * dz`.

    Attributes:
        gray: (H, W) uint8.
        colour: (H, W, 3) RGB, or None for a gray camera.
        inside: (H, W) bool, False where the image did not reach.
        px_per_m: patch pixels per metre.
        image_px_per_m: original image pixels per metre: the true resolution.
        origin_px: (2,) where the object's middle at `plane_z_m` lies, u and v.
        parallax_px_per_m: (2,) shift in the patch per metre of height.
        growth_per_m: relative magnification per metre of height: one over the camera's distance; 0 in a plane view.
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

    def pixel_of(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> tuple[Array, Array]:
        """Patch coordinates (u, v) of object points; `z_m` defaults to the patch's plane."""
        dz = np.asarray(0.0 if z_m is None else np.asarray(z_m, float) - self.plane_z_m)
        scale = self.px_per_m * (1.0 + self.growth_per_m * dz)
        u = self.origin_px[0] + scale * np.asarray(x_m, float) + self.parallax_px_per_m[0] * dz
        v = self.origin_px[1] - scale * np.asarray(y_m, float) + self.parallax_px_per_m[1] * dz
        return u, v

    def sample(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> NDArray[np.float32]:
        """Gray values (bilinear, float32) at object points of any common shape of one or two dimensions."""
        u, v = self.pixel_of(x_m, y_m, z_m)
        return sample_at(self.gray, u, v)

    def seen(self, x_m: ArrayLike, y_m: ArrayLike, z_m: ArrayLike | None = None) -> float:
        """Share of the object points that lie inside the image and are not saturated."""
        u, v = self.pixel_of(x_m, y_m, z_m)
        good = (self.inside & (self.gray < WHITE_LEVEL)).astype(np.uint8)
        return float(sample_at(good, u, v).mean())


def sample_at(image: NDArray[Any], u: Array, v: Array, *, outside: float | None = None) -> NDArray[np.float32]:
    """Bilinear values at coordinates of one or two dimensions; the border repeats unless `outside` is given."""
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
    """The patch of `centre_m` (x, y on the plate) out to the half sizes, at height `plane_z_m`.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        shift_px: (2,) what the object's own registration found: added to the projected points.
        gray: the gray version of `image`, to save its making.
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
    """(N, 2) patch coordinates of places given in half sizes from the middle, y up."""
    return np.asarray(middle_px + places * np.array([1.0, -1.0]) * middle_px, float)


def _bend(missed_px: Array) -> NDArray[np.float32] | None:
    """What a homography through the corners misses at the `NODES`, image px, as a grid; None when that is little.

    Towards the border of a view a lens with k1 = -0.08 bends a slider's track by more than a pixel.
    """
    if not np.isfinite(missed_px).all() or np.abs(missed_px).max() < LEAST_BEND_PX:
        return None
    return missed_px.reshape(BEND_NODES, BEND_NODES, 2).astype(np.float32)


def _warp(image: Image, patch_from_image: Array, size: tuple[int, int], bend_px: NDArray[np.float32] | None) -> Image:
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
    """Image coordinates u and v, each (H, W), of every patch pixel: through the homography, plus the bend."""
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
    corners = np.array([[0, 0], [size[0] - 1, 0], [size[0] - 1, size[1] - 1], [0, size[1] - 1]], float)
    back = _apply(image_from_patch, corners)
    if (back >= 0).all() and (back[:, 0] <= shape[1] - 1).all() and (back[:, 1] <= shape[0] - 1).all():
        return np.ones((size[1], size[0]), bool)
    ones = np.ones(shape[:2], np.uint8)
    return np.asarray(cv2.warpPerspective(ones, patch_from_image, size, flags=cv2.INTER_NEAREST)) > 0


def _apply(h: Array, points: Array) -> Array:
    u = np.column_stack([points, np.ones(len(points))]) @ h.T
    return np.asarray(u[:, :2] / u[:, 2:])


def _area(quad: Array) -> float:
    x, y = quad.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
