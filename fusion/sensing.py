"""From what a sensor says to a measurement with its distance function (paper section IV-B, eq 13).

Every function takes `base_from_sensor: UncertainPose`, so that what is not known about the arm or the mounting enters C and M, and
propagates covariances to first order. Which of the nine classes comes out depends on the feature given: a touched point on an
edge is point-line, on a face point-plane. Pixels are undistorted first (perception's camera model); camera axes are x right,
y down, z forward. Measurements from one sensor pose share its error; the fusion takes them as independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fusion.features import Feature, Kind, unit
from fusion.measurement import Measurement, measurement
from hal.errors import InvalidRequest, NotObservable
from hal.geometry import Array, UncertainPose, matrix_of, point_covariance, skew

SMALLEST_SIGMA_M = 1e-6  # nothing is placed better than a micrometre
SMALLEST_SIGMA_RAD = 1e-6
STEP = 1e-5  # of the central differences, in units of a parameter's standard deviation scale (m, rad, px alike)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pinhole:
    """A camera without distortion: focal lengths and principal point in pixels."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def ray(self, pixel_px: ArrayLike) -> Array:
        """(3,) unit direction in the camera frame of an undistorted pixel (u, v)."""
        u, v = np.asarray(pixel_px, float)
        ray = np.array([(u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px, 1.0])
        return np.asarray(ray / np.linalg.norm(ray))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A camera and where it stood: what one eye of a stereo pair is."""

    base_from_camera: UncertainPose
    camera: Pinhole


def touch(
    feature: Feature,
    base_from_finger: UncertainPose,
    *,
    sigma_m: float,
    tip_m: ArrayLike = (0.0, 0.0, 0.0),
    label: str = "",
    sensor: str = "touch",
) -> Measurement:
    """A fingertip felt `feature`: point-point, point-line or point-plane.

    Args:
        feature: what was touched, object frame.
        base_from_finger: pose of the finger at contact.
        sigma_m: standard deviation of the contact place, same in all directions.
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
    """A distance along the sensor's z axis to `feature`: point-point, point-line or point-plane.

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
    """A sensed point with any covariance: point-point, point-line or point-plane.

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
    return measurement(feature, Kind.POINT, mu_m=mu, C_m2=_floored(C), label=label, sensor=sensor)


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
    """A plane fitted to a range image: plane-plane, or plane-line and plane-point for what lies in it.

    Args:
        feature: what lies in the plane, object frame.
        base_from_sensor: pose of the scanner.
        point_m: (3,) middle of the fitted patch, sensor frame: there offset and tilt are independent.
        normal: (3,) of the plane, sensor frame, either sense.
        offset_sigma_m: standard deviation along the normal.
        normal_sigma_rad: standard deviation of the normal about any axis across it.
    """
    n = unit(normal, "normal")
    variances = np.diag([offset_sigma_m**2] * 3 + [normal_sigma_rad**2] * 3)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.asarray(point_m, float) + x[:3], Rotation.from_rotvec(x[3:6]).apply(n)

    return _sensed(feature, Kind.PLANE, sensed, variances, base_from_sensor, label, sensor)


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
    """A point (a vertex, a light) seen by one camera: line-point, the line from the lens through the point.

    Args:
        feature: the point, object frame.
        base_from_camera: pose of the camera.
        pixel_px: (2,) undistorted image place.
        sigma_px: its standard deviation per axis.
        camera: the camera.
    """
    place = np.asarray(pixel_px, float)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.zeros(3), camera.ray(place + x[:2])

    return _sensed(feature, Kind.LINE, sensed, sigma_px**2 * np.eye(2), base_from_camera, label, sensor)


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
    """An edge seen by one camera: plane-line, the plane of the lens and the image line.

    Args:
        feature: the edge, object frame.
        base_from_camera: pose of the camera.
        ends_px: (2, 2) two undistorted points on the image line, far apart; they need not be the edge's ends.
        sigma_px: their standard deviation per axis.
        camera: the camera.

    Raises:
        InvalidRequest: the two points are less than a pixel apart.
    """
    ends = _ends(ends_px)

    def sensed(x: Array) -> tuple[Array, Array]:
        return np.zeros(3), _image_plane(camera, ends + x[:4].reshape(2, 2))

    return _sensed(feature, Kind.PLANE, sensed, sigma_px**2 * np.eye(4), base_from_camera, label, sensor)


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
        lenses, rays = _rays(views, places + x[:4].reshape(2, 2), x[4:])
        return _closest(lenses, rays)

    covariance = _block([sigma_px**2 * np.eye(4), *(v.base_from_camera.covariance for v in views)])
    J = _jacobian(placed, len(covariance))
    return measurement(
        feature,
        Kind.POINT,
        mu_m=placed(np.zeros(len(covariance))),
        C_m2=_floored(J @ covariance @ J.T),
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
    ends = np.array([_ends(e) for e in np.asarray(ends_px, float)])
    toward = _middle_ray(views[0], ends[0])

    def sensed(x: Array) -> tuple[Array, Array]:
        lenses, normals = [], []
        for k, view in enumerate(views):
            lens, R = _moved(view.base_from_camera, x[8 + 6 * k : 14 + 6 * k])
            lenses.append(lens)
            normals.append(R @ _image_plane(view.camera, ends[k] + x[4 * k : 4 * k + 4].reshape(2, 2)))
        return _meet(lenses, normals, toward)

    covariance = _block([sigma_px**2 * np.eye(8), *(v.base_from_camera.covariance for v in views)])
    return _from_joint(feature, Kind.LINE, sensed, covariance, label, sensor)


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
    ends = _ends(ends_px)
    toward = _middle_ray(view, ends)

    def sensed(x: Array) -> tuple[Array, Array]:
        lens, R = _moved(view.base_from_camera, x[6:12])
        source, S = _moved(base_from_projector, x[12:18])
        sheet = S @ unit([x[4], x[5], 1.0])
        seen = R @ _image_plane(view.camera, ends + x[:4].reshape(2, 2))
        return _meet([lens, source], [seen, sheet], toward)

    covariance = _block([
        sigma_px**2 * np.eye(4), sheet_sigma_rad**2 * np.eye(2),
        view.base_from_camera.covariance, base_from_projector.covariance,
    ])  # fmt: skip
    return _from_joint(feature, Kind.LINE, sensed, covariance, label, sensor)


def _sensed(
    feature: Feature,
    sensed_kind: Kind,
    sensed: Callable[[Array], tuple[Array, Array]],
    own: Array,
    pose: UncertainPose,
    label: str,
    sensor: str,
) -> Measurement:
    """Measurement from a place and direction in one sensor's frame that depend on errors x with covariance `own`."""
    k = len(own)

    def in_base(x: Array) -> tuple[Array, Array]:
        place, direction = sensed(x[:k])
        origin, R = _moved(pose, x[k : k + 6])
        return origin + R @ place, R @ direction

    return _from_joint(feature, sensed_kind, in_base, _block([own, pose.covariance]), label, sensor)


def _from_joint(
    feature: Feature,
    sensed_kind: Kind,
    sensed: Callable[[Array], tuple[Array, Array]],
    covariance: Array,
    label: str,
    sensor: str,
) -> Measurement:
    """Measurement from a place and direction in the base that depend on errors x with `covariance`."""
    place, direction = sensed(np.zeros(len(covariance)))

    def joined(x: Array) -> Array:
        p, d = sensed(x)
        return np.concatenate([p, d if d @ direction > 0 else -d])

    J = _jacobian(joined, len(covariance))
    joint = J @ covariance @ J.T
    shift = _best_known(joint, direction, sensed_kind)
    K = np.hstack([np.eye(3), _lever(shift, direction)])
    return measurement(
        feature,
        sensed_kind,
        mu_m=place + shift,
        C_m2=_floored(K @ joint @ K.T),
        M=_information(joint[3:, 3:], direction),
        label=label,
        sensor=sensor,
    )


def _lever(shift: Array, direction: Array) -> Array:
    """d(shift)/d(direction) when the shifted place stays on the line or plane: the shift turns with the direction."""
    along = float(shift @ direction)
    across = shift - along * direction
    # along a line the place moves with the direction; in a plane it sinks when the normal leans towards it
    return along * np.eye(3) - np.outer(direction, across)


def _best_known(joint: Array, direction: Array, kind: Kind) -> Array:
    """Shift along the line, or in the plane, to the place whose error is least coupled to the direction's.

    eq 13 has no term between place and direction, so they had better be independent where it is evaluated.
    """
    P = np.eye(3) - np.outer(direction, direction)
    spread, coupled = P @ joint[3:, 3:] @ P, joint[:3, 3:]
    if kind == Kind.LINE:
        total = float(np.trace(spread))
        return np.asarray(-np.trace(P @ coupled) / total * direction) if total > 0 else np.zeros(3)
    # offset error d.dp - s.dd is uncoupled from dd where s = spread^+ coupled^T d
    return np.asarray(P @ np.linalg.pinv(spread, rcond=1e-6) @ (P @ coupled.T @ direction))


def _information(spread: Array, direction: Array) -> Array:
    """M: the inverse of a direction's covariance (3, 3) across the direction, zero along it."""
    T = np.linalg.svd(direction[None])[2][1:].T
    across = T.T @ spread @ T + SMALLEST_SIGMA_RAD**2 * np.eye(2)
    return np.asarray(T @ np.linalg.inv(across) @ T.T)


def _floored(C: Array) -> Array:
    """A covariance that no direction escapes."""
    C = (C + C.T) / 2
    return np.asarray(C + max(SMALLEST_SIGMA_M**2, 1e-9 * np.trace(C)) * np.eye(3))


def _jacobian(function: Callable[[Array], Array], n: int) -> Array:
    """(len(function), n) central differences at zero."""
    eye = STEP * np.eye(n)
    return np.column_stack([(function(e) - function(-e)) / (2 * STEP) for e in eye])


def _block(blocks: Sequence[Array]) -> Array:
    sizes = np.cumsum([0, *(len(b) for b in blocks)])
    out = np.zeros((sizes[-1], sizes[-1]))
    for a, b, block in zip(sizes[:-1], sizes[1:], blocks, strict=True):
        out[a:b, a:b] = block
    return out


def _moved(pose: UncertainPose, delta: Array) -> tuple[Array, Array]:
    """Origin (3,) and axes (3, 3) of a pose with error `delta` (6,)."""
    child = pose.parent_from_child
    W, angle = skew(delta[3:]), float(np.linalg.norm(delta[3:]))
    turn = np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * W @ W  # Rodrigues
    return np.asarray(child.translation + delta[:3]), turn @ matrix_of(child)


def _ends(ends_px: ArrayLike) -> Array:
    ends = np.asarray(ends_px, float)
    if ends.shape != (2, 2) or not np.isfinite(ends).all():
        raise InvalidRequest("an image line needs two points (u, v)", hint="give [[u1, v1], [u2, v2]] in pixels")
    if np.linalg.norm(ends[1] - ends[0]) < 1.0:
        raise InvalidRequest("the two points of an image line coincide", hint="take points far apart on the line")
    return ends


def _image_plane(camera: Pinhole, ends: Array) -> Array:
    """(3,) unit normal, camera frame, of the plane through the lens and two image points."""
    return unit(np.cross(camera.ray(ends[0]), camera.ray(ends[1])))


def _middle_ray(view: View, ends: Array) -> tuple[Array, Array]:
    """Lens and ray (base) of the middle of an image line: where along an endless line the sensor looked."""
    pose = view.base_from_camera.parent_from_child
    return np.asarray(pose.translation), matrix_of(pose) @ view.camera.ray(ends.mean(axis=0))


def _rays(views: Sequence[View], pixels: Array, deltas: Array) -> tuple[list[Array], list[Array]]:
    lenses, rays = [], []
    for k, view in enumerate(views):
        lens, R = _moved(view.base_from_camera, deltas[6 * k : 6 * k + 6])
        lenses.append(lens)
        rays.append(R @ view.camera.ray(pixels[k]))
    return lenses, rays


def _closest(points: Sequence[Array], directions: Sequence[Array]) -> Array:
    """The point nearest to all lines, in least squares.

    Raises:
        NotObservable: the lines are parallel.
    """
    across = [np.eye(3) - np.outer(d, d) for d in directions]
    A = np.sum(across, axis=0)
    if np.linalg.cond(A) > 1e8:
        raise NotObservable("the rays are parallel", hint="move the camera sideways between the views")
    return np.asarray(np.linalg.solve(A, np.sum([P @ p for P, p in zip(across, points, strict=True)], axis=0)))


def _meet(points: Sequence[Array], normals: Sequence[Array], toward: tuple[Array, Array]) -> tuple[Array, Array]:
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
