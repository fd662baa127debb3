"""Measurements of one camera: a pixel is a line through the lens, an edge in the image a plane through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion.features import Feature, Kind, unit
from fusion.measurement import Measurement
from fusion.sensing.propagation import sensed_by
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose


@dataclass(frozen=True, slots=True, kw_only=True)
class Pinhole:
    """A camera without distortion: focal lengths and principal point in pixels."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def ray(self, pixel_px: ArrayLike) -> Array:
        """Return the (3,) unit direction in the camera frame of an undistorted pixel (u, v)."""
        u, v = np.asarray(pixel_px, float)
        ray = np.array([(u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px, 1.0])
        return np.asarray(ray / np.linalg.norm(ray))


def pixel(
    feature: Feature,
    base_from_camera: UncertainPose,
    *,
    pixel_px: ArrayLike,
    sigma_px: float,
    camera: Pinhole,
    label: str = "",
    sensor: str = "camera",
) -> Measurement:
    """Return the measurement of a point (a vertex, a light) by one camera, of class line-point: a line from the lens.

    Args:
        feature: the point, object frame.
        base_from_camera: pose of the camera.
        pixel_px: (2,) undistorted image point.
        sigma_px: its standard deviation per axis.
        camera: the camera.
    """
    place = np.asarray(pixel_px, float)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.zeros(3), camera.ray(place + x[:2])

    return sensed_by(feature, Kind.LINE, sensed, sigma_px**2 * np.eye(2), base_from_camera, label, sensor)


def image_line(
    feature: Feature,
    base_from_camera: UncertainPose,
    *,
    ends_px: ArrayLike,
    sigma_px: float,
    camera: Pinhole,
    label: str = "",
    sensor: str = "camera",
) -> Measurement:
    """Return the measurement of an edge by one camera, of class plane-line: the plane of lens and image line.

    Args:
        feature: the edge, object frame.
        base_from_camera: pose of the camera.
        ends_px: (2, 2) two undistorted points on the image line, far apart; they need not be the edge's ends.
        sigma_px: their standard deviation per axis.
        camera: the camera.

    Raises:
        InvalidRequest: the two points are less than a pixel apart.
    """
    ends = _checked_ends(ends_px)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.zeros(3), _image_plane(camera, ends + x[:4].reshape(2, 2))

    return sensed_by(feature, Kind.PLANE, sensed, sigma_px**2 * np.eye(4), base_from_camera, label, sensor)


def _checked_ends(ends_px: ArrayLike) -> Array:
    ends = np.asarray(ends_px, float)
    if ends.shape != (2, 2) or not np.isfinite(ends).all():
        raise InvalidRequest("an image line needs two points (u, v)", hint="give [[u1, v1], [u2, v2]] in pixels")
    if np.linalg.norm(ends[1] - ends[0]) < 1.0:
        raise InvalidRequest("the two points of an image line coincide", hint="take points far apart on the line")
    return ends


def _image_plane(camera: Pinhole, ends: Array) -> Array:
    """Return the (3,) unit normal, camera frame, of the plane through the lens and two image points."""
    return unit(np.cross(camera.ray(ends[0]), camera.ray(ends[1])))
