"""The paper's lens correction (Section II-B): a bivariate cubic from the measured to the ideal pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project, undistort_pixels
from perception.calibration.boards import BoardView

GRID = 24  # points along each side of the image at which the bias is evaluated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CubicLens:
    """The paper's lens correction (Section II-B): ideal pixel = bivariate cubic of the distorted pixel.

    Attributes:
        coefficients: (10, 2), one column per axis, over the monomials of `cubic_monomials`.
        centre_px, scale_px: for numerical conditioning, the monomials are those of `(pixel - centre_px) / scale_px`.
        bias_px: root mean square model error of the cubic over the image; more data do not reduce it.
    """

    coefficients: Array
    centre_px: tuple[float, float]
    scale_px: float
    bias_px: float

    def ideal(self, pixels_px: ArrayLike) -> Array:
        """Return the ideal pixels (N, 2) of distorted ones (N, 2)."""
        return cubic_monomials(pixels_px, self.centre_px, self.scale_px) @ self.coefficients


def cubic_monomials(pixels_px: ArrayLike, centre_px: tuple[float, float], scale_px: float) -> Array:
    """Return the monomials (N, 10) 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3 of the scaled pixels."""
    x, y = ((np.asarray(pixels_px, float) - centre_px) / scale_px).T
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def fit_cubic(views: Sequence[BoardView], intrinsics: CameraIntrinsics, poses: Sequence[RigidTransform]) -> CubicLens:
    """Fit the paper's correction: linear least squares of the points' ideal pixels over cubics of the measured ones."""
    width, height = intrinsics.width_px, intrinsics.height_px
    centre, scale = ((width - 1) / 2.0, (height - 1) / 2.0), width / 2.0
    straight = replace(intrinsics, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
    measured = np.concatenate([view.pixels_px for view in views])
    ideal = np.concatenate(
        [project(pose.apply(view.points_m), straight) for view, pose in zip(views, poses, strict=True)]
    )
    coefficients = np.linalg.lstsq(cubic_monomials(measured, centre, scale), ideal, rcond=None)[0]
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    grid = np.column_stack([u.ravel(), v.ravel()])
    miss = cubic_monomials(grid, centre, scale) @ coefficients - undistort_pixels(grid, intrinsics)
    bias_px = float(np.sqrt(np.nanmean(np.sum(miss**2, axis=1))))
    return CubicLens(coefficients=coefficients, centre_px=centre, scale_px=scale, bias_px=bias_px)
