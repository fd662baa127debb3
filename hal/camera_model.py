"""Projects points to pixels and converts pixels to rays, for a pinhole camera with a radial-tangential lens model.

Camera axes: x right, y down, z along the view. Pixel (0, 0) is the centre of the upper left pixel.
Lens model: D. C. Brown, Photogrammetric Engineering 37(8), 1971, in OpenCV's order (k1, k2, p1, p2, k3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest

NEWTON_STEPS = 20  # 4 to 6 steps reach 1e-15 for |k1| <= 0.3; the image corners need more


def project(points_camera_m: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return the (N, 2) pixels of (N, 3) points in camera axes; NaN for a point that is not in front of the camera.

    Raises:
        InvalidRequest: the points do not have the shape (N, 3).
    """
    points = _points(points_camera_m, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = np.where(points[:, 2:] > 0, points[:, :2] / points[:, 2:], np.nan)
    return _to_pixels(distort(normalised, intrinsics), intrinsics)


def project_with_jacobian(points_camera_m: ArrayLike, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """Return the (N, 2) pixels of points and their (N, 2, 3) derivatives (px/m) by the point in camera axes."""
    points = _points(points_camera_m, 3)
    depth = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    normalised = points[:, :2] / depth[:, None]
    d_normalised = np.zeros((len(points), 2, 3))
    d_normalised[:, 0, 0] = d_normalised[:, 1, 1] = 1.0 / depth
    d_normalised[:, :, 2] = -normalised / depth[:, None]
    focal = np.array([intrinsics.fx_px, intrinsics.fy_px])
    jacobian = focal[:, None] * (distortion_jacobian(normalised, intrinsics) @ d_normalised)
    return _to_pixels(distort(normalised, intrinsics), intrinsics), jacobian


def disc_offset_px(
    points_m: ArrayLike, radius_m: ArrayLike, camera_from_plate: RigidTransform, intrinsics: CameraIntrinsics
) -> Array:
    """Return the offset from the image of a disc's centre to the centre of the disc's image, (N, 2) px.

    The offset is not zero because the near half of the disc looks larger.

    The centre of the ellipse is the image of c - r^2 / c_z (a - (n a) n), where c is the disc's centre, r its radius, a
    the optical axis and n the disc's normal. It is the pole of the line at infinity for the dual conic r^2 (I - n n^T)
    - c c^T of the disc (Hartley, Zisserman, Multiple View Geometry, Section 8.3).

    Args:
        points_m: (N, 3) centres of discs that are parallel to the plate, in the plate frame (z is the normal).
        radius_m: radius of each disc.
        camera_from_plate: pose of the plate; an approximate one is enough.
    """
    middles = _points(points_m, 3)
    seen_m = camera_from_plate.apply(middles)
    axis = camera_from_plate.as_matrix()[2, :3]  # the optical axis in the plate's frame
    aside = np.outer(np.square(radius_m) / seen_m[:, 2], [axis[0], axis[1], 0.0])
    return project(camera_from_plate.apply(middles - aside), intrinsics) - project(seen_m, intrinsics)


def distort(normalised: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return (N, 2) distorted normalised coordinates from ideal ones (x = X/Z, y = Y/Z)."""
    x, y = np.asarray(normalised, float).T
    k1, k2, p1, p2, k3 = intrinsics.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def distortion_jacobian(normalised: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return the (N, 2, 2) derivatives of `distort` with respect to its argument."""
    x, y = np.asarray(normalised, float).T
    k1, k2, p1, p2, k3 = intrinsics.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d r2, times 2
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    jacobian = np.empty((len(x), 2, 2))
    jacobian[:, 0, 0] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    jacobian[:, 1, 1] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = cross
    return jacobian


def undistort_normalised(distorted: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return (N, 2) ideal normalised coordinates from distorted ones, by Newton's method.

    They are NaN where the lens model has no inverse, that is, beyond the radius where the distorted radius decreases.
    """
    target = np.asarray(distorted, float)
    if not any(intrinsics.distortion):
        return target.copy()
    ideal = target.copy()
    for _ in range(NEWTON_STEPS):
        error = target - distort(ideal, intrinsics)
        if np.nanmax(np.abs(error), initial=0.0) < 1e-15:
            break
        jacobian = distortion_jacobian(ideal, intrinsics)
        determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (
                np.stack(
                    [
                        jacobian[:, 1, 1] * error[:, 0] - jacobian[:, 0, 1] * error[:, 1],
                        jacobian[:, 0, 0] * error[:, 1] - jacobian[:, 1, 0] * error[:, 0],
                    ],
                    axis=1,
                )
                / np.where(determinant > 0, determinant, np.nan)[:, None]
            )
        ideal = ideal + step
    residual = np.abs(target - distort(ideal, intrinsics)).max(axis=1)
    return np.where((residual < 1e-9)[:, None], ideal, np.nan)


def undistort_pixels(pixels_px: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return the (N, 2) pixels of an ideal pinhole with the same focal lengths and centre, from (N, 2) measured ones.

    They are NaN where the lens model has no inverse.
    """
    pixels = _points(pixels_px, 2)
    return _to_pixels(undistort_normalised(_to_normalised(pixels, intrinsics), intrinsics), intrinsics)


def normalised_with_jacobian(pixels_px: ArrayLike, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """Return (N, 2) ideal normalised coordinates and their (N, 2, 2) derivatives by the measured pixels."""
    ideal = undistort_normalised(_to_normalised(_points(pixels_px, 2), intrinsics), intrinsics)
    scale = np.array([1.0 / intrinsics.fx_px, 1.0 / intrinsics.fy_px])
    if not any(intrinsics.distortion):
        return ideal, np.broadcast_to(np.diag(scale), (len(ideal), 2, 2)).copy()
    jacobian = distortion_jacobian(ideal, intrinsics)
    jacobian = np.where(np.isfinite(jacobian), jacobian, np.eye(2))  # for `inv`; such a point stays NaN in `ideal`
    return ideal, np.linalg.inv(jacobian) * scale


def rays(pixels_px: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """Return the (N, 3) unit directions, in camera axes, of (N, 2) pixels; NaN where the lens model has no inverse."""
    ideal = _to_normalised(undistort_pixels(pixels_px, intrinsics), intrinsics)
    directions = np.column_stack([ideal, np.ones(len(ideal))])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def check_size(image: NDArray[Any], intrinsics: CameraIntrinsics) -> None:
    """Check that an image has the size that the intrinsics are for.

    Raises:
        InvalidRequest: the sizes differ.
    """
    if image.shape[:2] != (intrinsics.height_px, intrinsics.width_px):
        raise InvalidRequest(
            f"image is {image.shape[1]}x{image.shape[0]}, the calibration is for "
            f"{intrinsics.width_px}x{intrinsics.height_px}",
            hint="use the calibration of this camera at this resolution",
        )


def _to_normalised(pixels_px: Array, intrinsics: CameraIntrinsics) -> Array:
    centre = np.array([intrinsics.cx_px, intrinsics.cy_px])
    return np.asarray((pixels_px - centre) / [intrinsics.fx_px, intrinsics.fy_px])


def _to_pixels(normalised: Array, intrinsics: CameraIntrinsics) -> Array:
    return np.asarray(normalised * [intrinsics.fx_px, intrinsics.fy_px] + [intrinsics.cx_px, intrinsics.cy_px])


def _points(points: ArrayLike, width: int) -> Array:
    array = np.asarray(points, float)
    if array.ndim != 2 or array.shape[1] != width:
        raise InvalidRequest(f"points must be (N, {width}), not {array.shape}", hint="give one row per point")
    return array
