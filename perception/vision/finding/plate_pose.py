"""Pose of a plate of known size in front of a camera of known or typical focal length: six parameters instead of eight.

Two of a homography's eight degrees of freedom are no motion of a rigid plate. Without them a side that is outside the
image, or hidden by a cable or glare, follows from the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from perception.vision.projection import homography


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidPlate:
    """Projection (`PanelProjection`) of a rigid plate.

    It moves by a rotation (rad, camera axes), then by a shift in units of its distance.

    Attributes:
        R, t_m: camera_from_plate, (3, 3) and (3,).
        focal_px, middle_px: of a camera without lens distortion.
        sigma_px: standard deviation of the motion, as its effect on a pixel.
    """

    R: Array
    t_m: Array
    focal_px: float
    middle_px: Array
    sigma_px: float

    @property
    def prior_sigma(self) -> Array:
        """Rotations and relative shifts (6,) that move the plate's border by about `sigma_px`."""
        reach = self.sigma_px / self.focal_px
        return np.array([4.0 * reach] * 3 + [reach, reach, 2.0 * reach])

    @property
    def px_from_plate(self) -> Array:
        """Homography (3, 3) from the plate (m) to pixels."""
        K = np.array([[self.focal_px, 0, self.middle_px[0]], [0, self.focal_px, self.middle_px[1]], [0, 0, 1.0]])
        return np.asarray(K @ np.column_stack([self.R[:, 0], self.R[:, 1], self.t_m]))

    def project(self, points_m: ArrayLike) -> Array:
        """Return the pixels (N, 2) of points (N, 2 or 3) of the plate's plane; NaN behind the camera."""
        points = np.asarray(points_m, float)[:, :2]
        H = self.px_from_plate
        h = points @ H[:, :2].T + H[:, 2]
        return np.asarray(h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan))

    def moved(self, delta: Array) -> RigidPlate:
        """Return the plate after a motion by `delta` (6,)."""
        turn = cv2.Rodrigues(np.asarray(delta[:3], float))[0]
        return replace(self, R=turn @ self.R, t_m=self.t_m + float(np.linalg.norm(self.t_m)) * delta[3:])

    def motion(self, points_m: ArrayLike) -> Array:
        """Return the derivatives (N, 2, 6) of the pixels of points (N, 2 or 3) of the plate's plane over the motion."""
        turned = np.asarray(points_m, float)[:, :2] @ self.R[:, :2].T
        x, y, z = (turned + self.t_m).T
        by_shift = np.zeros((len(turned), 2, 3))
        by_shift[:, 0, 0] = by_shift[:, 1, 1] = self.focal_px / z
        by_shift[:, 0, 2], by_shift[:, 1, 2] = -self.focal_px * x / z**2, -self.focal_px * y / z**2
        by_turn = np.cross(turned[:, None], by_shift)  # g . (e x a) = e . (a x g)
        return np.concatenate([by_turn, float(np.linalg.norm(self.t_m)) * by_shift], axis=2)


def rigid_plate(
    corners_m: Array, corners_px: Array, *, focal_px: float, middle_px: Array, sigma_px: float
) -> RigidPlate:
    """Return the rigid plate that fits four corners best.

    The columns of K^-1 H are r1, r2 and t up to a common factor (Z. Zhang, IEEE PAMI 22(11), 2000, sec. 3.1); the
    nearest rotation follows from a singular value decomposition.
    """
    H = homography(corners_m, corners_px)
    K = np.array([[focal_px, 0, middle_px[0]], [0, focal_px, middle_px[1]], [0, 0, 1.0]])
    h = np.linalg.solve(K, H)
    scale = 2.0 / float(np.linalg.norm(h[:, 0]) + np.linalg.norm(h[:, 1]))
    h = h * (scale if h[2, 2] > 0 else -scale)
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    R = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return RigidPlate(R=R, t_m=h[:, 2], focal_px=focal_px, middle_px=middle_px, sigma_px=sigma_px)
