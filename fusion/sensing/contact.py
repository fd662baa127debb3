"""Measurements by touch, proximity and range: a point or a plane in the sensor's own frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fusion.features import Feature, Kind, unit
from fusion.measurement import Measurement, measurement
from fusion.sensing.propagation import floored, sensed_by
from hal.arrays import Array
from hal.geometry import UncertainPose, matrix_of, point_covariance


def touch(
    feature: Feature,
    base_from_finger: UncertainPose,
    *,
    sigma_m: float,
    tip_m: ArrayLike = (0.0, 0.0, 0.0),
    label: str = "",
    sensor: str = "touch",
) -> Measurement:
    """Return the measurement of a fingertip contact with `feature`: point-point, point-line or point-plane.

    Args:
        feature: what was touched, object frame.
        base_from_finger: pose of the finger at contact.
        sigma_m: standard deviation of the contact point, the same in all directions.
        tip_m: (3,) the tip in the finger frame.
    """
    return range_point(
        feature, base_from_finger, point_m=tip_m, covariance_m2=sigma_m**2 * np.eye(3), label=label, sensor=sensor
    )


def proximity(
    feature: Feature,
    base_from_sensor: UncertainPose,
    *,
    distance_m: float,
    sigma_m: float,
    lateral_sigma_m: float,
    label: str = "",
    sensor: str = "proximity",
) -> Measurement:
    """Return the measurement of a distance along the sensor's z axis to `feature`: point-point, -line or -plane.

    Args:
        feature: what was sensed, object frame.
        base_from_sensor: pose of the sensor; z points at the surface.
        distance_m: the reading, m.
        sigma_m: its standard deviation.
        lateral_sigma_m: half width of the sensed spot, as a standard deviation across the axis.
    """
    covariance = np.diag([lateral_sigma_m**2, lateral_sigma_m**2, sigma_m**2])
    return range_point(
        feature, base_from_sensor, point_m=(0, 0, distance_m), covariance_m2=covariance, label=label, sensor=sensor
    )


def range_point(
    feature: Feature,
    base_from_sensor: UncertainPose,
    *,
    point_m: ArrayLike,
    covariance_m2: ArrayLike,
    label: str = "",
    sensor: str = "range",
) -> Measurement:
    """Return the measurement of a sensed point with any covariance: point-point, point-line or point-plane.

    Args:
        feature: what the point lies on, object frame.
        base_from_sensor: pose of the sensor.
        point_m: (3,) in the sensor frame.
        covariance_m2: (3, 3) of the point in the sensor frame.
    """
    pose = base_from_sensor.parent_from_child
    R = matrix_of(pose)
    C = R @ np.asarray(covariance_m2, float) @ R.T + point_covariance(base_from_sensor, point_m)
    mu = pose.apply(np.asarray(point_m, float))
    return measurement(feature, Kind.POINT, mu_m=mu, C_m2=floored(C), label=label, sensor=sensor)


def range_plane(
    feature: Feature,
    base_from_sensor: UncertainPose,
    *,
    point_m: ArrayLike,
    normal: ArrayLike,
    offset_sigma_m: float,
    normal_sigma_rad: float,
    label: str = "",
    sensor: str = "range",
) -> Measurement:
    """Return the measurement of a plane fitted to a range image: plane-plane, or -line and -point for features in it.

    Args:
        feature: what lies in the plane, object frame.
        base_from_sensor: pose of the scanner.
        point_m: (3,) centroid of the fitted patch, sensor frame, where offset and tilt are independent.
        normal: (3,) of the plane, sensor frame, either sense.
        offset_sigma_m: standard deviation along the normal.
        normal_sigma_rad: standard deviation of the normal about any axis across it.
    """
    n = unit(normal, "normal")
    variances = np.diag([offset_sigma_m**2] * 3 + [normal_sigma_rad**2] * 3)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.asarray(point_m, float) + x[:3], Rotation.from_rotvec(x[3:6]).apply(n)

    return sensed_by(feature, Kind.PLANE, sensed, variances, base_from_sensor, label, sensor)
