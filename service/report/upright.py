"""Turns pictures by quarters so that the panel stands upright in them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array, Image


def quarter_turns(camera_from_panel: RigidTransform) -> int:
    """Return how often, 0 to 3, an image must be turned a quarter to the left so that the panel's top is above."""
    right, down, _ = camera_from_panel.rotation.as_matrix()[:, 1]  # the panel's upward axis in the camera
    return round((math.pi / 2 - math.atan2(-down, right)) / (math.pi / 2)) % 4


def turned_image(image: Image, turns: int) -> Image:
    """Return the image, turned so many quarters to the left."""
    return np.ascontiguousarray(np.rot90(image, turns))


def turned_points(points_px: Array, size_px: tuple[int, int], turns: int) -> NDArray[np.float64]:
    """Return points, px (N, 2), in the image of (width, height) turned so many quarters to the left."""
    points, (width, height) = np.array(points_px, float), size_px
    for _ in range(turns):
        points = np.stack([points[:, 1], width - 1 - points[:, 0]], axis=1)
        width, height = height, width
    return points
