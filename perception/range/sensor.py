"""Sensor models, which give the ray of each pixel of a depth image.

A pixel (u, v) with depth z is the point `O + z D` in the sensor frame (x right, y down, z away from the sensor, in
metres); each model defines O and D. Depth is measured along the sensor's z axis, not along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.errors import InvalidRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeSensor:
    """Pinhole camera: O = 0, D = ((u - cx) / fx, (v - cy) / fy, 1). Focal lengths and image centre are in pixels."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        if not (self.fx_px > 0 and self.fy_px > 0 and np.isfinite([self.fx_px, self.fy_px]).all()):
            raise InvalidRequest(
                f"focal lengths {self.fx_px}, {self.fy_px} px are not positive",
                hint="give fx and fy of the range sensor in pixels",
            )

    def packed(self) -> Array:
        """Return perspective flag (1), fx, fy, cx and cy as an array (5,), the form that compiled loops read."""
        return np.array([1.0, self.fx_px, self.fy_px, self.cx_px, self.cy_px])

    def pitch_m(self, depth_m: float) -> float:
        """Return the distance in metres between neighbouring pixels on a wall that faces the sensor at `depth_m`."""
        return depth_m / (0.5 * (self.fx_px + self.fy_px))

    def points(self, depth_m: Array) -> Array:
        """Return the points (H, W, 3) of a depth image in the sensor frame, metres; NaN where the depth is NaN."""
        x, y = _plane_coordinates(self)
        return np.stack([x * depth_m, y * depth_m, depth_m], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthographicSensor:
    """Parallel projection: O = ((u - (W-1)/2) pitch, (v - (H-1)/2) pitch, 0), D = (0, 0, 1); the paper's g(u, v)."""

    width_px: int
    height_px: int
    pixel_pitch_m: float

    def __post_init__(self) -> None:
        if not (self.pixel_pitch_m > 0 and np.isfinite(self.pixel_pitch_m)):
            raise InvalidRequest(
                f"pixel pitch {self.pixel_pitch_m} m is not positive", hint="give the pixel pitch in metres"
            )

    def packed(self) -> Array:
        """Return perspective flag (0), 1 / pitch (twice), cx and cy as (5,), the form that compiled loops read."""
        per_metre = 1.0 / self.pixel_pitch_m
        return np.array([0.0, per_metre, per_metre, (self.width_px - 1) / 2, (self.height_px - 1) / 2])

    def pitch_m(self, depth_m: float) -> float:  # noqa: ARG002 - the same at every depth
        """Return the distance in metres between neighbouring pixels."""
        return self.pixel_pitch_m

    def points(self, depth_m: Array) -> Array:
        """Return the points (H, W, 3) of a depth image in the sensor frame, metres; NaN where the depth is NaN."""
        x, y = _plane_coordinates(self)
        return np.stack([np.where(np.isnan(depth_m), np.nan, v) for v in (x, y)] + [depth_m], axis=-1)


RangeSensorModel = PinholeSensor | OrthographicSensor


def _plane_coordinates(sensor: RangeSensorModel) -> tuple[Array, Array]:
    """Return the ray coordinates x, y (H, W): on the plane z = 1 (pinhole) or in metres (orthographic)."""
    _, fx, fy, cx, cy = sensor.packed()
    v, u = np.mgrid[: sensor.height_px, : sensor.width_px].astype(float)
    return (u - cx) / fx, (v - cy) / fy
