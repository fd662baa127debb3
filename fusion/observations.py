"""Readings of mounted sensors, and the measurements that fusion makes from them.

An observation keeps a reading apart from the pose of its sensor. So an error of the mounting, which all readings of one
sensor share, can be added afterwards (`fusion.shared_errors`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import sensing
from fusion.features import plane, point
from fusion.measurement import Measurement
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import undistort_pixels
from hal.geometry import UncertainPose

PLATE = plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), name="plate")


class Observation(Protocol):
    """One reading of a mounted sensor, with the pose of the arm's flange at that time.

    Attributes:
        sensor: name of the device that gave the reading.
        base_from_flange: flange pose at the time of the reading.
        sigmas: (k,) one standard deviation of each independent error of the reading itself.
    """

    @property
    def sensor(self) -> str: ...

    @property
    def base_from_flange(self) -> RigidTransform: ...

    @property
    def sigmas(self) -> Array: ...

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """Return the measurement that the reading makes when `errors` (k,) are added to it."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelObservation:
    """A point of the panel, for example a border light, seen by a camera.

    Attributes:
        sensor, base_from_flange: as `Observation`.
        name: name of the point.
        point_m: (3,) panel frame.
        pixel_px: (2,) its image, not undistorted.
        covariance_px: (2, 2) px^2, of noise, lens and the tolerance of the point's own position together.
        intrinsics: the camera's calibration.
    """

    sensor: str
    base_from_flange: RigidTransform
    name: str
    point_m: Array
    pixel_px: Array
    covariance_px: Array
    intrinsics: CameraIntrinsics

    @property
    def sigmas(self) -> Array:
        """(2,) across and along the image, px."""
        return np.full(2, float(np.sqrt(np.trace(self.covariance_px) / 2.0)))

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """Return the ray through the point, of class line-point."""
        lens = self.intrinsics
        return sensing.pixel(
            point(self.point_m, name=self.name),
            base_from_sensor,
            pixel_px=undistort_pixels((self.pixel_px + errors)[None], lens)[0],
            sigma_px=float(self.sigmas[0]),
            camera=sensing.Pinhole(fx_px=lens.fx_px, fy_px=lens.fy_px, cx_px=lens.cx_px, cy_px=lens.cy_px),
            label=f"ray to {self.name}",
            sensor=self.sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaneObservation:
    """The plane of the plate, fitted to a range image.

    Attributes:
        sensor, base_from_flange: as `Observation`.
        point_m, normal: (3,) centroid of the fitted points and unit normal, sensor frame.
        point_covariance, normal_covariance: (3, 3) of both, m^2 and rad^2.
        systematic_offset_m, systematic_angle_rad: the scanner's specified systematic errors beyond noise, one sigma.
    """

    sensor: str
    base_from_flange: RigidTransform
    point_m: Array
    normal: Array
    point_covariance: Array
    normal_covariance: Array
    systematic_offset_m: float = 0.0003
    systematic_angle_rad: float = 0.0005

    @property
    def sigmas(self) -> Array:
        """(3,) offset along the normal (m), then tilt about two axes across it (rad)."""
        offset = np.sqrt(max(0.0, float(self.normal @ self.point_covariance @ self.normal)))
        tilt = np.sqrt(float(np.trace(self.normal_covariance)) / 2.0)
        angle = float(np.hypot(tilt, self.systematic_angle_rad))
        return np.array([float(np.hypot(offset, self.systematic_offset_m)), angle, angle])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """Return the fitted plane, of class plane-plane."""
        across = np.linalg.svd(self.normal[None])[2][1:]
        turn = Rotation.from_rotvec(errors[1] * across[0] + errors[2] * across[1])
        return sensing.range_plane(
            PLATE,
            base_from_sensor,
            point_m=self.point_m + errors[0] * self.normal,
            normal=turn.apply(self.normal),
            offset_sigma_m=float(self.sigmas[0]),
            normal_sigma_rad=float(self.sigmas[1]),
            label="plate by range",
            sensor=self.sensor,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TouchObservation:
    """A contact of the fingertip with the plate: `tip_m` (3,) in the frame of the gripper."""

    sensor: str
    base_from_flange: RigidTransform
    tip_m: Array
    sigma_m: float
    label: str

    @property
    def sigmas(self) -> Array:
        """(1,) along the finger, m; nothing is measured across it."""
        return np.array([self.sigma_m])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """Return a point of the plate, of class point-plane."""
        tip = self.tip_m + np.array([0.0, 0.0, errors[0]])
        return sensing.touch(
            PLATE, base_from_sensor, sigma_m=self.sigma_m, tip_m=tip, label=self.label, sensor=self.sensor
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProximityObservation:
    """A distance to the plate along the sensor's z axis, m."""

    sensor: str
    base_from_flange: RigidTransform
    distance_m: float
    sigma_m: float
    label: str

    @property
    def sigmas(self) -> Array:
        """(1,) along the beam, m."""
        return np.array([self.sigma_m])

    def measurement(self, base_from_sensor: UncertainPose, errors: Array) -> Measurement:
        """Return a point of the plate, of class point-plane."""
        return sensing.proximity(
            PLATE,
            base_from_sensor,
            distance_m=self.distance_m + float(errors[0]),
            sigma_m=self.sigma_m,
            lateral_sigma_m=0.002,
            label=self.label,
            sensor=self.sensor,
        )
