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

    def motion(self, points_m: ArrayLike) -> Array:
        """Return the derivatives (N, 2, n) of the pixels of panel points (N, 3) over the motion parameters."""
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

    def motion(self, points_m: ArrayLike) -> Array:
        """Return the derivatives (N, 2, 6) of the pixels over the perturbation, by finite differences."""
        base, bumps = self.project(points_m), np.diag(1e-3 * self.prior_sigma)
        return np.stack([(self.moved(bump).project(points_m) - base) / bump.sum() for bump in bumps], axis=2)


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

    def motion(self, points_m: ArrayLike) -> Array:
        """Return the derivatives (N, 2, 8) of the pixels over the coordinates of the control points.

        The equations A h = u determine the homography's elements h by the control points' coordinates u. As A contains
        u as well, dh = A^-1 diag(w) du with the points' depths w. Of any points it is du = diag(1 / w) A dh.
        """
        points = np.asarray(points_m, float)[:, :2]
        of_points, of_corners = (_equations(at, self.project(at)) for at in (points, self.corners_m))
        last = self.px_from_plate[2] / self.px_from_plate[2, 2]
        depth, corner_depth = (np.tile(at @ last[:2] + 1.0, 2) for at in (points, self.corners_m))
        J = (of_points / depth[:, None]) @ (np.linalg.inv(of_corners) * corner_depth)
        return np.asarray(J.reshape(2, len(points), 2, 4).transpose(1, 0, 3, 2).reshape(len(points), 2, 8))


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
    return np.append(np.linalg.solve(_equations(source, target), target.T.ravel()), 1.0).reshape(3, 3)


def _equations(source: Array, target: Array) -> Array:
    """Return the matrix A (2 N, 8) of the equations A h = u of a homography's elements h, of which the last one is 1.

    The coordinates u of the targets (N, 2) are all those across, then all those down.
    """
    n = len(source)
    A = np.zeros((2 * n, 8))
    A[:n, :2] = A[n:, 3:5] = source
    A[:n, 2] = A[n:, 5] = 1.0
    A[:, 6:] = -target.T.reshape(-1, 1) * np.tile(source, (2, 1))
    return A
