"""Projection of panel points to pixels: by a calibrated camera with a known pose, or by a homography of the plate.

Both kinds of view can be moved by a few parameters with a prior, so that registration is the same for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, perturbed

LEAST_CORNER = 0.05  # sine of the turn at a corner; with less three corners are nearly on one line


class PanelProjection(Protocol):
    """Projection of panel points (m, panel frame, z towards the viewer) to pixels, with a small uncertain motion."""

    @property
    def prior_sigma(self) -> Array:
        """Prior standard deviation (n,) of every motion parameter."""
        ...

    def project(self, points_m: ArrayLike) -> Array:
        """Return the pixels (N, 2) of panel points (N, 3); NaN behind the camera."""
        ...

    def moved(self, delta: Array) -> Self:
        """Return the view after a motion with parameters `delta` (n,)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraProjection:
    """A calibrated camera in front of the panel.

    It moves by `delta = (d, r)` of hal.geometry, m and rad, camera axes.
    """

    intrinsics: CameraIntrinsics
    camera_from_panel: UncertainPose

    @property
    def prior_sigma(self) -> Array:
        """Standard deviations (6,) of the pose, at least as large as the building tolerance requires."""
        floor = np.array([2e-4, 2e-4, 5e-4, 5e-4, 5e-4, 5e-4])
        return np.asarray(np.maximum(np.sqrt(np.diag(self.camera_from_panel.covariance)), floor))

    def project(self, points_m: ArrayLike) -> Array:
        """Return the pixels (N, 2) of panel points (N, 3)."""
        points = self.camera_from_panel.parent_from_child.apply(np.asarray(points_m, float))

        return np.asarray(project(points, self.intrinsics))

    def moved(self, delta: Array) -> CameraProjection:
        """Return the view with the pose perturbed by `delta` (6,)."""
        pose = perturbed(self.camera_from_panel.parent_from_child, delta)
        return CameraProjection(
            intrinsics=self.intrinsics,
            camera_from_panel=UncertainPose(parent_from_child=pose, covariance=self.camera_from_panel.covariance),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlateProjection:
    """A homography from the plate (x, y in m, y up) to pixels, which ignores heights.

    It moves by the shifts (px) of four control points, so its prior is in pixels.

    Attributes:
        px_from_plate: (3, 3).
        corners_m: (4, 2) the control points on the plate.
        sigma_px: standard deviation of each coordinate of a control point.
    """

    px_from_plate: Array
    corners_m: Array
    sigma_px: float = 2.0

    @property
    def prior_sigma(self) -> Array:
        """Standard deviation (8,) of the coordinates of the control points, px."""
        return np.full(8, self.sigma_px)

    def project(self, points_m: ArrayLike) -> Array:
        """Return the pixels (N, 2) of plate points (N, 2 or 3)."""
        points = np.asarray(points_m, float)[:, :2]
        u = points @ self.px_from_plate[:, :2].T + self.px_from_plate[:, 2]
        return np.asarray(u[:, :2] / u[:, 2:])

    def moved(self, delta: Array) -> PlateProjection:
        """Return the view with the control points shifted by `delta` (8,), px."""
        shifted = self.project(self.corners_m) + delta.reshape(4, 2)
        return PlateProjection(
            px_from_plate=homography(self.corners_m, shifted), corners_m=self.corners_m, sigma_px=self.sigma_px
        )


def plate_by_corners(corners_px: ArrayLike, plate_m: tuple[float, float]) -> PlateProjection:
    """Return the view of an upright plate of known size whose corners (4, 2) were clicked, in any order.

    Raises:
        InvalidRequest: the corners are not those of a convex quadrangle.
    """
    clicked = np.asarray(corners_px, float)
    away = clicked - clicked.mean(axis=0)
    around = clicked[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]  # clockwise in the image, where y points down
    upper_left = int((around @ [1.0, 1.0]).argmin())
    corners = np.roll(around, -upper_left, axis=0)
    sides = np.roll(corners, -1, axis=0) - corners
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    lengths = np.linalg.norm(sides, axis=1)
    if not (turns > LEAST_CORNER * lengths * np.roll(lengths, -1)).all():
        raise InvalidRequest(
            "the four corners are not those of a plate: three lie on one line, or one lies between the others",
            hint="click the four corners of the upright plate, each once",
        )
    width, height = plate_m
    corners_m = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * [width / 2, height / 2]
    return PlateProjection(px_from_plate=homography(corners_m, corners), corners_m=corners_m)


def homography(source: Array, target: Array) -> Array:
    """Return the homography (3, 3) that maps four source points (4, 2) to four target points."""
    A = np.zeros((8, 8))
    x, y = source.T
    u, v = target.T
    A[:4, 0], A[:4, 1], A[:4, 2] = x, y, 1.0
    A[:4, 6], A[:4, 7] = -u * x, -u * y
    A[4:, 3], A[4:, 4], A[4:, 5] = x, y, 1.0
    A[4:, 6], A[4:, 7] = -v * x, -v * y
    return np.append(np.linalg.solve(A, np.concatenate([u, v])), 1.0).reshape(3, 3)
