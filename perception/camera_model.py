"""Points to pixels and back: pinhole with the radial-tangential lens, and the paper's cubic correction as an option.

Camera axes: x right, y down, z along the view. Pixel (0, 0) is the centre of the upper left pixel.
Lens model: D. C. Brown, Photogrammetric Engineering 37(8), 1971, in OpenCV's order (k1, k2, p1, p2, k3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.errors import InvalidRequest

NEWTON_STEPS = 20  # quadratic convergence reaches 1e-15 in 4 to 6 for |k1| <= 0.3; the rest serves the image corners


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CubicLens:
    """The paper's lens correction (Section II-B): ideal pixel = bivariate cubic of the distorted pixel.

    Attributes:
        coefficients: (10, 2), one column an axis, over the monomials of `cubic_monomials`.
        centre_px, scale_px: the monomials are taken of `(pixel - centre_px) / scale_px`, for conditioning.
        bias_px: root mean square of what the cubic cannot follow over the frame. It is bias: data do not shrink it.
    """

    coefficients: Array
    centre_px: tuple[float, float]
    scale_px: float
    bias_px: float

    def ideal(self, pixels_px: ArrayLike) -> Array:
        """(N, 2) ideal pixels of (N, 2) distorted ones."""
        return cubic_monomials(pixels_px, self.centre_px, self.scale_px) @ self.coefficients


def cubic_monomials(pixels_px: ArrayLike, centre_px: tuple[float, float], scale_px: float) -> Array:
    """(N, 10) monomials 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3 of the scaled pixel."""
    x, y = ((_points(pixels_px, 2) - centre_px) / scale_px).T
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def project(points_camera_m: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """(N, 2) pixels of (N, 3) points in camera axes; NaN for a point that is not in front of the camera.

    Raises:
        InvalidRequest: wrong shape.
    """
    points = _points(points_camera_m, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = np.where(points[:, 2:] > 0, points[:, :2] / points[:, 2:], np.nan)
    return _to_pixels(distort(normalised, intrinsics), intrinsics)


def project_with_jacobian(points_camera_m: ArrayLike, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """(N, 2) pixels and their (N, 2, 3) derivatives (px per metre) by the point in camera axes."""
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
    """How far the middle of a disc's image lies from the image of its middle, (N, 2) px: the near half looks larger.

    The middle of the ellipse is the image of c - r^2 / c_z (a - (n a) n), a the optical axis and n the disc's normal:
    the pole of the line at infinity by the dual conic r^2 (I - n n^T) - c c^T of the disc (Hartley, Zisserman,
    Multiple View Geometry, Section 8.3).

    Args:
        points_m: (N, 3) middles of discs that lie in the plate (its normal is z), plate frame.
        radius_m: of each.
        camera_from_plate: where the plate stands; roughly is enough.
    """
    middles = _points(points_m, 3)
    seen_m = camera_from_plate.apply(middles)
    axis = camera_from_plate.as_matrix()[2, :3]  # the optical axis in the plate's frame
    aside = np.outer(np.square(radius_m) / seen_m[:, 2], [axis[0], axis[1], 0.0])
    return project(camera_from_plate.apply(middles - aside), intrinsics) - project(seen_m, intrinsics)


def distort(normalised: ArrayLike, intrinsics: CameraIntrinsics) -> Array:
    """(N, 2) distorted from ideal normalised coordinates (x = X/Z, y = Y/Z)."""
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
    """(N, 2, 2) derivatives of `distort` by its argument."""
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
    """(N, 2) ideal from distorted normalised coordinates, by Newton's method.

    NaN where the lens model has no inverse, that is beyond the radius at which it folds back.
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


def undistort_pixels(pixels_px: ArrayLike, intrinsics: CameraIntrinsics, *, cubic: CubicLens | None = None) -> Array:
    """(N, 2) pixels that an ideal pinhole with the same focal lengths and centre would show.

    Args:
        pixels_px: (N, 2) as measured.
        intrinsics: the camera; its `distortion` is used unless `cubic` is given.
        cubic: the paper's cubic correction, used in place of the radial-tangential model.

    Returns: NaN where the lens model has no inverse.
    """
    pixels = _points(pixels_px, 2)
    if cubic is not None:
        return cubic.ideal(pixels)
    return _to_pixels(undistort_normalised(_to_normalised(pixels, intrinsics), intrinsics), intrinsics)


def normalised_with_jacobian(pixels_px: ArrayLike, intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """(N, 2) ideal normalised coordinates and their (N, 2, 2) derivatives by the measured pixel."""
    ideal = undistort_normalised(_to_normalised(_points(pixels_px, 2), intrinsics), intrinsics)
    scale = np.array([1.0 / intrinsics.fx_px, 1.0 / intrinsics.fy_px])
    if not any(intrinsics.distortion):
        return ideal, np.broadcast_to(np.diag(scale), (len(ideal), 2, 2)).copy()
    jacobian = distortion_jacobian(ideal, intrinsics)
    jacobian = np.where(np.isfinite(jacobian), jacobian, np.eye(2))  # a folded point stays NaN in `ideal`
    return ideal, np.linalg.inv(jacobian) * scale


def rays(pixels_px: ArrayLike, intrinsics: CameraIntrinsics, *, cubic: CubicLens | None = None) -> Array:
    """(N, 3) unit directions in camera axes through (N, 2) pixels; NaN where the lens model has no inverse."""
    ideal = _to_normalised(undistort_pixels(pixels_px, intrinsics, cubic=cubic), intrinsics)
    directions = np.column_stack([ideal, np.ones(len(ideal))])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def undistort_image(image: NDArray[Any], intrinsics: CameraIntrinsics) -> NDArray[Any]:
    """The image that the ideal pinhole would show, same size and type; bilinear, black outside.

    Args:
        image: (H, W) or (H, W, C) with the size that `intrinsics` names.

    Raises:
        InvalidRequest: the image has another size than the calibration.
    """
    import cv2

    check_size(image, intrinsics)
    v, u = np.mgrid[: intrinsics.height_px, : intrinsics.width_px]
    ideal = _to_normalised(np.stack([u.ravel(), v.ravel()], axis=1).astype(float), intrinsics)
    source = _to_pixels(distort(ideal, intrinsics), intrinsics).astype(np.float32).reshape(*u.shape, 2)
    return np.asarray(cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR))


def check_size(image: NDArray[Any], intrinsics: CameraIntrinsics) -> None:
    """Refuse an image whose size is not the calibration's.

    Raises:
        InvalidRequest: sizes differ.
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
        raise InvalidRequest(f"points must be (N, {width}), not {array.shape}", hint="one row a point")
    return array
