"""Pinhole pictures of the world through PyBullet's portable software renderer: colour and body ids, or depth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

Array = NDArray[np.float64]

LIGHT_DIRECTION = (-0.6, 0.5, 1.1)  # from the scene towards the lamp: behind the arm, from above
AMBIENT, DIFFUSE, SPECULAR = 0.62, 0.42, 0.0


class Renderer:
    """Draws on request; changes nothing in the world."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine

    def draw(
        self,
        base_from_camera: RigidTransform,
        *,
        width: int,
        height: int,
        focal: tuple[float, float],
        centre: tuple[float, float],
        near_m: float,
        far_m: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int32]]:
        """RGBA (H, W, 4), depth along the view (H, W) in metres and body ids (H, W)."""
        engine = self._engine
        _, _, rgba, depth, ids = engine.getCameraImage(
            width,
            height,
            viewMatrix=view_matrix(base_from_camera),
            projectionMatrix=projection_matrix(width, height, focal, centre, near_m, far_m),
            renderer=engine.ER_TINY_RENDERER,
            shadow=0,
            lightDirection=LIGHT_DIRECTION,
            lightColor=(1.0, 1.0, 1.0),
            lightAmbientCoeff=AMBIENT,
            lightDiffuseCoeff=DIFFUSE,
            lightSpecularCoeff=SPECULAR,
        )
        depth = np.asarray(depth, np.float32).reshape(height, width)
        along = far_m * near_m / (far_m - (far_m - near_m) * depth)
        return np.asarray(rgba, np.uint8).reshape(height, width, 4), along, np.asarray(ids, np.int32).reshape(height, width)


def view_matrix(base_from_camera: RigidTransform) -> list[float]:
    """OpenGL's view matrix, column by column; its camera looks along -z with y up, ours along +z with y down."""
    camera_from_base = np.asarray(base_from_camera.inv().as_matrix())
    return [float(x) for x in (np.diag([1.0, -1.0, -1.0, 1.0]) @ camera_from_base).T.ravel()]


def projection_matrix(
    width: int, height: int, focal: tuple[float, float], centre: tuple[float, float], near_m: float, far_m: float
) -> list[float]:
    """OpenGL's projection, column by column, of a pinhole whose pixel (0, 0) is a pixel's centre."""
    (fx, fy), (cx, cy) = focal, centre
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 2] = 2.0 * fx / width, 1.0 - 2.0 * (cx + 0.5) / width
    matrix[1, 1], matrix[1, 2] = 2.0 * fy / height, 2.0 * (cy + 0.5) / height - 1.0
    matrix[2, 2] = -(far_m + near_m) / (far_m - near_m)
    matrix[2, 3] = -2.0 * far_m * near_m / (far_m - near_m)
    matrix[3, 2] = -1.0
    return [float(x) for x in matrix.T.ravel()]
