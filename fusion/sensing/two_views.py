"""Two views of one thing: stereo, and a camera beside a projected sheet of light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fusion.features import Feature, Kind, unit
from fusion.measurement import Measurement, measurement
from fusion.sensing.camera import View, checked_ends, image_plane, middle_ray
from fusion.sensing.propagation import block_diagonal, floored, from_joint, jacobian, moved
from hal.arrays import Array
from hal.errors import NotObservable
from hal.geometry import UncertainPose


def stereo_point(
    feature: Feature,
    views: Sequence[View],
    *,
    pixels_px: ArrayLike,
    sigma_px: float,
    label: str = "",
    sensor: str = "stereo",
) -> Measurement:
    """A point seen from two places: point-point (or point-line, point-plane), where the rays pass closest.

    Args:
        feature: what the point lies on, object frame.
        views: the two cameras and their poses.
        pixels_px: (2, 2) undistorted image place in each view.
        sigma_px: their standard deviation per axis.

    Raises:
        NotObservable: the two rays are parallel.
    """
    places = np.asarray(pixels_px, float)

    def placed(x: Array) -> Array:
        lenses, rays = rays_at(views, places + x[:4].reshape(2, 2), x[4:])
        return nearest_point(lenses, rays)

    covariance = block_diagonal([sigma_px**2 * np.eye(4), *(v.base_from_camera.covariance for v in views)])
    J = jacobian(placed, len(covariance))
    return measurement(
        feature,
        Kind.POINT,
        mu_m=placed(np.zeros(len(covariance))),
        C_m2=floored(J @ covariance @ J.T),
        label=label,
        sensor=sensor,
    )


def stereo_line(
    feature: Feature,
    views: Sequence[View],
    *,
    ends_px: ArrayLike,
    sigma_px: float,
    label: str = "",
    sensor: str = "stereo",
) -> Measurement:
    """An edge seen from two places: line-line (or line-plane), where the two planes through the lenses meet.

    Args:
        feature: the edge, or a plane that the seen line lies in, object frame.
        views: the two cameras and their poses.
        ends_px: (2, 2, 2) for each view two undistorted points of the image line.
        sigma_px: their standard deviation per axis.

    Raises:
        NotObservable: the two planes are one: the line runs along the base line between the cameras.
    """
    ends = np.array([checked_ends(e) for e in np.asarray(ends_px, float)])
    toward = middle_ray(views[0], ends[0])

    def sensed(x: Array) -> tuple[Array, Array]:
        lenses, normals = [], []
        for k, view in enumerate(views):
            lens, R = moved(view.base_from_camera, x[8 + 6 * k : 14 + 6 * k])
            lenses.append(lens)
            normals.append(R @ image_plane(view.camera, ends[k] + x[4 * k : 4 * k + 4].reshape(2, 2)))
        return meeting_line(lenses, normals, toward)

    covariance = block_diagonal([sigma_px**2 * np.eye(8), *(v.base_from_camera.covariance for v in views)])
    return from_joint(feature, Kind.LINE, sensed, covariance, label, sensor)


def light_stripe(
    feature: Feature,
    view: View,
    base_from_projector: UncertainPose,
    *,
    ends_px: ArrayLike,
    sigma_px: float,
    sheet_sigma_rad: float = 0.0,
    label: str = "",
    sensor: str = "stripe",
) -> Measurement:
    """A sheet of light on a face, seen by a camera: line-plane, where the sheet and the seen plane meet.

    Args:
        feature: the face that the stripe lies on, object frame.
        view: the camera and its pose.
        base_from_projector: pose of the projector; the sheet is its plane z = 0.
        ends_px: (2, 2) two undistorted points of the stripe in the image.
        sigma_px: their standard deviation per axis.
        sheet_sigma_rad: standard deviation of the sheet's tilt, beyond the projector pose's own.

    Raises:
        NotObservable: the camera looks along the sheet.
    """
    ends = checked_ends(ends_px)
    toward = middle_ray(view, ends)

    def sensed(x: Array) -> tuple[Array, Array]:
        lens, R = moved(view.base_from_camera, x[6:12])
        source, S = moved(base_from_projector, x[12:18])
        sheet = S @ unit([x[4], x[5], 1.0])
        seen = R @ image_plane(view.camera, ends + x[:4].reshape(2, 2))
        return meeting_line([lens, source], [seen, sheet], toward)

    covariance = block_diagonal([
        sigma_px**2 * np.eye(4), sheet_sigma_rad**2 * np.eye(2),
        view.base_from_camera.covariance, base_from_projector.covariance,
    ])  # fmt: skip
    return from_joint(feature, Kind.LINE, sensed, covariance, label, sensor)


def rays_at(views: Sequence[View], pixels: Array, deltas: Array) -> tuple[list[Array], list[Array]]:
    lenses, rays = [], []
    for k, view in enumerate(views):
        lens, R = moved(view.base_from_camera, deltas[6 * k : 6 * k + 6])
        lenses.append(lens)
        rays.append(R @ view.camera.ray(pixels[k]))
    return lenses, rays


def nearest_point(points: Sequence[Array], directions: Sequence[Array]) -> Array:
    """The point nearest to all lines, in least squares.

    Raises:
        NotObservable: the lines are parallel.
    """
    across = [np.eye(3) - np.outer(d, d) for d in directions]
    A = np.sum(across, axis=0)
    if np.linalg.cond(A) > 1e8:
        raise NotObservable("the rays are parallel", hint="move the camera sideways between the views")
    return np.asarray(np.linalg.solve(A, np.sum([P @ p for P, p in zip(across, points, strict=True)], axis=0)))


def meeting_line(points: Sequence[Array], normals: Sequence[Array], toward: tuple[Array, Array]) -> tuple[Array, Array]:
    """A point and the direction of the line in which two planes meet; the point is the nearest one to the ray `toward`.

    Raises:
        NotObservable: the planes are parallel.
    """
    direction = np.cross(normals[0], normals[1])
    if np.linalg.norm(direction) < 1e-6:
        raise NotObservable("the two planes through the lenses are one", hint="look from a place off this line's plane")
    d = unit(direction)
    A = np.array([normals[0], normals[1], d])
    on_line = np.linalg.solve(A, np.array([normals[0] @ points[0], normals[1] @ points[1], 0.0]))
    lens, ray = toward
    across = np.eye(3) - np.outer(ray, ray)
    s = float(d @ across @ (lens - on_line)) / max(float(d @ across @ d), 1e-12)
    return on_line + s * d, d
