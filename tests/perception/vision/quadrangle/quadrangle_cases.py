"""Random views of four lights, computed by numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics

CAMERA = CameraIntrinsics(width_px=1280, height_px=960, fx_px=800.0, fy_px=805.0, cx_px=640.0, cy_px=480.0)
BENT = CameraIntrinsics(
    width_px=1280, height_px=960, fx_px=800.0, fy_px=805.0, cx_px=640.0, cy_px=480.0,
    distortion=(-0.2, 0.05, 0.001, -0.001, 0.0),
)  # fmt: skip
RECTANGLE = np.array([[-0.15, -0.1, 0.0], [0.15, -0.1, 0.0], [0.15, 0.1, 0.0], [-0.15, 0.1, 0.0]])
SHAPES = {
    "rectangle": RECTANGLE,
    "square": np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]),
    "raised": RECTANGLE + np.array([[0, 0, 0], [0, 0, 0.03], [0, 0, 0], [0, 0, 0.06]]),
    "parallelogram": np.array([[-0.15, -0.1, 0.0], [0.12, -0.1, 0.0], [0.2, 0.1, 0.0], [-0.07, 0.1, 0.0]]),
    "irregular": np.array([[-0.16, -0.07, 0.3], [0.11, -0.12, 0.3], [0.17, 0.08, 0.3], [-0.1, 0.13, 0.3]]),
    "three in a row": np.array([[-0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.05, 0.2, 0.0]]),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """True pose, camera_from_object, and exact pixels."""

    points_m: Array
    R: Array
    t: Array
    pixels: Array


def view(rng: np.random.Generator, shape: str, *, tilt_deg: float, range_m: float = 1.0) -> View:
    """Return a view of the shape's front, tilted by `tilt_deg` from the line of sight, with random roll."""
    points = SHAPES[shape]
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    sight = np.array([rng.uniform(-0.13, 0.13), rng.uniform(-0.13, 0.13), 1.0])
    onto = Rotation.align_vectors([-sight / np.linalg.norm(sight)], [normal])[0]
    roll = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * sight / np.linalg.norm(sight))
    across = np.cross(sight, rng.normal(size=3))
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * across / np.linalg.norm(across))
    R = (tilt * roll * onto).as_matrix()
    t = sight * range_m - R @ points.mean(axis=0)
    return View(points_m=points, R=R, t=t, pixels=pixels_of(points, R, t))


def pixels_of(points_m: Array, R: Array, t: Array) -> Array:
    """Return (..., N, 2) pixels of `CAMERA` for rotations (..., 3, 3) and translations (..., 3); NaN behind it."""
    q = points_m @ R.swapaxes(-1, -2) + t[..., None, :]
    z = np.where(q[..., 2:] > 0, q[..., 2:], np.nan)
    return np.asarray(q[..., :2] / z * [CAMERA.fx_px, CAMERA.fy_px] + [CAMERA.cx_px, CAMERA.cy_px])


def angle_deg(A: Array, B: Array) -> float:
    """Return the angle between two rotations."""
    return float(np.degrees(Rotation.from_matrix(A @ B.T).magnitude()))
