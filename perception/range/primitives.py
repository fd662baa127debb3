"""Named surfaces with their parameters and covariance, in the sensor frame, metres and radians."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.arrays import Array
from hal.jit import compiled
from perception.range.fitting.initialisation import principal_axes
from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, QUADRIC, SIZE, SPHERE, frame_of, step_into


class SurfaceType(StrEnum):
    """What a surface is."""

    PLANE = "plane"
    SPHERE = "sphere"
    CYLINDER = "cylinder"
    CONE = "cone"
    ELLIPSOID = "ellipsoid"


TYPE_OF_KIND = {
    PLANE: SurfaceType.PLANE,
    SPHERE: SurfaceType.SPHERE,
    CYLINDER: SurfaceType.CYLINDER,
    CONE: SurfaceType.CONE,
    QUADRIC: SurfaceType.ELLIPSOID,
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plane:
    """All X with `normal . (X - point_m) = 0`; `normal` (3,) points to the sensor, `point_m` (3,) is the middle."""

    point_m: Array
    normal: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sphere:
    """Centre (3,) and radius; `seen_from_inside` tells a bowl from a ball."""

    centre_m: Array
    radius_m: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cylinder:
    """Point of the axis nearest the middle of the region (3,), unit axis (3,), radius."""

    point_m: Array
    axis: Array
    radius_m: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cone:
    """Apex (3,), unit axis from the apex into the cone (3,), angle between axis and wall."""

    apex_m: Array
    axis: Array
    half_angle_rad: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ellipsoid:
    """Centre (3,), radii (3,) longest first, and their directions as the columns of `axes` (3, 3)."""

    centre_m: Array
    radii_m: Array
    axes: Array


Primitive = Plane | Sphere | Cylinder | Cone | Ellipsoid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """One region of the image and the primitive that explains it.

    Attributes:
        label: its value in `RangeScene.labels`.
        primitive: parameters in the sensor frame.
        covariance: (p, p) over `covariance_over`; shifts in metres, tilts and angles in radians.
        covariance_over: names of the p tangent parameters. `tilt_1` and `tilt_2` turn the unit vector towards the
            first and second vector of `frame`; `across_1`, `across_2` shift the axis along them.
        frame: (2, 3) those two vectors.
        pixels: pixels with this label.
        rms_m: root mean square residual in depth of the pixels that the fit kept.
        misfit: the same in standard deviations of the noise model; near 1 when model and noise are right.
        middle_m: (3,) median-depth point of the region.
    """

    label: int
    type: SurfaceType
    primitive: Primitive
    covariance: Array
    covariance_over: tuple[str, ...]
    frame: Array
    pixels: int
    rms_m: float
    misfit: float
    middle_m: Array


COVARIANCE_OVER = {
    PLANE: ("tilt_1", "tilt_2", "offset"),
    SPHERE: ("x", "y", "z", "radius"),
    CYLINDER: ("across_1", "across_2", "tilt_1", "tilt_2", "radius"),
    CONE: ("x", "y", "z", "tilt_1", "tilt_2", "half_angle"),
    QUADRIC: ("x", "y", "z", "radius_1", "radius_2", "radius_3"),
}


def primitive_of(kind: int, th: Array, middle_m: Array) -> Primitive:
    """The named primitive of a parameter vector (see `surfaces`); `middle_m` (3,) anchors planes and axes."""
    if kind == PLANE:
        normal = th[:3].copy()
        return Plane(point_m=_along(middle_m, float(th[3]) - _dot(normal, middle_m), normal), normal=normal)
    if kind == SPHERE:
        return Sphere(centre_m=th[:3].copy(), radius_m=float(th[3]), seen_from_inside=bool(th[4] < 0))
    if kind == CYLINDER:
        axis = th[3:6].copy()
        point = _along(th[:3], _dot(axis, middle_m) - _dot(axis, th[:3]), axis)
        return Cylinder(point_m=point, axis=axis, radius_m=float(th[6]), seen_from_inside=bool(th[7] < 0))
    if kind == CONE:
        return Cone(
            apex_m=th[:3].copy(), axis=th[3:6].copy(), half_angle_rad=float(th[6]), seen_from_inside=bool(th[7] < 0)
        )
    return ellipsoid_of(th)


def _dot(a: Array, b: Array) -> float:
    """Product of two vectors (3,): at this size plain numbers are faster than arrays."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return float(ax * bx + ay * by + az * bz)


def _along(point: Array, distance: float, direction: Array) -> Array:
    """(3,) the point that far away in a direction."""
    (x, y, z), (dx, dy, dz) = point.tolist(), direction.tolist()
    return np.array([x + distance * dx, y + distance * dy, z + distance * dz])


def ellipsoid_of(th: Array) -> Ellipsoid:
    """Centre, radii and axes of a QUADRIC parameter vector that is an ellipsoid.

    With X = centre + s Y and Y' A Y + 2 b' Y + c = 0: Y0 = -A^-1 b, radii_i = s sqrt((b' A^-1 b - c) / lambda_i).
    """
    A = np.array(
        [[th[4], 0.5 * th[7], 0.5 * th[8]], [0.5 * th[7], th[5], 0.5 * th[9]], [0.5 * th[8], 0.5 * th[9], th[6]]]
    )
    b = 0.5 * th[10:13]
    values, vectors = np.linalg.eigh(A)
    y0 = -np.linalg.solve(A, b)
    level = float(-b @ y0 - th[13])
    radii = th[3] * np.sqrt(np.maximum(level / values, 0.0))
    return Ellipsoid(centre_m=th[:3] + th[3] * y0, radii_m=radii, axes=vectors)


def frame_vectors(kind: int, th: Array) -> Array:
    """(2, 3) tangent vectors that `tilt_1`, `tilt_2`, `across_1` and `across_2` refer to."""
    frame = np.zeros(6)
    frame_of(kind, th, frame)
    return frame.reshape(2, 3)


def named_covariance(kind: int, th: Array, covariance: Array) -> Array:
    """Covariance over `COVARIANCE_OVER[kind]` from the one over the tangent parameters of `surfaces`."""
    if kind != QUADRIC:
        return covariance
    # Ellipsoids are fitted as coefficients; centre and radii follow by finite differences.
    step = np.sqrt(np.maximum(np.diag(covariance), 1e-20)) * 0.1
    J = _shape_jacobian(th, step)
    return np.asarray(J @ covariance @ J.T)


@compiled
def _shape_jacobian(th: Array, step: Array) -> Array:
    """(6, 9) central differences of centre and radii over the tangent parameters of a QUADRIC, `step` (9,) each way."""
    J, delta, frame = np.empty((6, 9)), np.zeros(9), np.zeros(6)
    before, after = np.empty(SIZE), np.empty(SIZE)
    for k in range(9):
        delta[k] = step[k]
        step_into(QUADRIC, th, frame, delta, after)
        delta[k] = -step[k]
        step_into(QUADRIC, th, frame, delta, before)
        delta[k] = 0.0
        J[:, k] = (centre_and_radii(after) - centre_and_radii(before)) / (2.0 * step[k])
    return J


@compiled
def centre_and_radii(th: Array) -> Array:
    """(6,) centre and radii of a QUADRIC, as `ellipsoid_of`."""
    A = np.array(
        [[th[4], 0.5 * th[7], 0.5 * th[8]], [0.5 * th[7], th[5], 0.5 * th[9]], [0.5 * th[8], 0.5 * th[9], th[6]]]
    )
    values, vectors = principal_axes(A)
    out, level = th[:6].copy(), -th[13]
    for k in range(3):
        t = 0.5 * (vectors[0, k] * th[10] + vectors[1, k] * th[11] + vectors[2, k] * th[12])
        level += t * t / values[k]
        for a in range(3):
            out[a] -= th[3] * vectors[a, k] * t / values[k]
    for k in range(3):
        out[3 + k] = th[3] * np.sqrt(max(level / values[k], 0.0))
    return out
