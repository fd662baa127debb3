"""Types of surfaces with parameters and covariance, in the sensor frame, metres and radians."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.arrays import Array
from hal.jit import compiled
from perception.range.fitting.initialisation import ellipsoid
from perception.range.fitting.surfaces import CONE, CYLINDER, PLANE, QUADRIC, SIZE, SPHERE, frame_of, step_into


class SurfaceType(StrEnum):
    """Geometric type of a surface."""

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
    """Plane of all X with `normal . (X - point_m) = 0`.

    `normal` (3,) is a unit vector towards the sensor; `point_m` (3,) is the point nearest the middle of the region.
    """

    point_m: Array
    normal: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sphere:
    """Sphere with centre (3,) and radius; `seen_from_inside` is true for a bowl and false for a ball."""

    centre_m: Array
    radius_m: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cylinder:
    """Cylinder with the point (3,) of its axis nearest the middle of the region, unit axis (3,) and radius."""

    point_m: Array
    axis: Array
    radius_m: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cone:
    """Cone with apex (3,), unit axis (3,) from the apex into the cone, and the angle between axis and surface."""

    apex_m: Array
    axis: Array
    half_angle_rad: float
    seen_from_inside: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ellipsoid:
    """Ellipsoid with centre (3,), radii (3,), longest first, and their directions as the columns of `axes` (3, 3)."""

    centre_m: Array
    radii_m: Array
    axes: Array


Primitive = Plane | Sphere | Cylinder | Cone | Ellipsoid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """One region of the image and the primitive that explains it.

    Attributes:
        label: value of its pixels in `RangeScene.labels`.
        primitive: parameters in the sensor frame.
        covariance: (p, p) over `covariance_over`; shifts in metres, tilts and angles in radians.
        covariance_over: names of the p tangent parameters. `tilt_1` and `tilt_2` turn the unit vector towards the
            first and second vector of `frame`; `across_1`, `across_2` shift the axis along them.
        frame: (2, 3) those two vectors.
        pixels: number of pixels with this label.
        rms_m: root mean square residual in depth of the pixels that the fit kept.
        misfit: the same in standard deviations of the noise model; near 1 if surface and noise model are right.
        middle_m: (3,) middle of the region: the point at the medians of ray coordinates and depth.
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
    """Build the primitive of a parameter vector (see `fitting.surfaces`).

    The reference point of a plane or of a cylinder's axis is the point nearest `middle_m` (3,).
    """
    if kind == PLANE:
        normal = th[:3].copy()
        return Plane(point_m=middle_m + (th[3] - normal @ middle_m) * normal, normal=normal)
    if kind == SPHERE:
        return Sphere(centre_m=th[:3].copy(), radius_m=float(th[3]), seen_from_inside=bool(th[4] < 0))
    if kind == CYLINDER:
        axis = th[3:6].copy()
        point = th[:3] + (axis @ middle_m - axis @ th[:3]) * axis
        return Cylinder(point_m=point, axis=axis, radius_m=float(th[6]), seen_from_inside=bool(th[7] < 0))
    if kind == CONE:
        return Cone(
            apex_m=th[:3].copy(), axis=th[3:6].copy(), half_angle_rad=float(th[6]), seen_from_inside=bool(th[7] < 0)
        )
    centre, radii, axes = ellipsoid(th)
    return Ellipsoid(centre_m=centre, radii_m=radii, axes=axes)


def frame_vectors(kind: int, th: Array) -> Array:
    """Return the tangent vectors (2, 3) to which `tilt_1`, `tilt_2`, `across_1` and `across_2` refer."""
    frame = np.zeros(6)
    frame_of(kind, th, frame)
    return frame.reshape(2, 3)


def named_covariance(kind: int, th: Array, covariance: Array) -> Array:
    """Convert a covariance over the tangent parameters of `fitting.surfaces` to one over `COVARIANCE_OVER[kind]`."""
    if kind != QUADRIC:
        return covariance
    # An ellipsoid is fitted by its coefficients; finite differences give the Jacobian of centre and radii.
    step = np.sqrt(np.maximum(np.diag(covariance), 1e-20)) * 0.1
    J = _shape_jacobian(th, step)
    return np.asarray(J @ covariance @ J.T)


@compiled
def _shape_jacobian(th: Array, step: Array) -> Array:
    """Return the Jacobian (6, 9) of centre and radii over a QUADRIC's tangent parameters, by central differences.

    `step` (9,): change of each parameter in either direction.
    """
    J, delta, frame = np.empty((6, 9)), np.zeros(9), np.zeros(6)
    before, after = np.empty(SIZE), np.empty(SIZE)
    for k in range(9):
        delta[k] = step[k]
        step_into(QUADRIC, th, frame, delta, after)
        delta[k] = -step[k]
        step_into(QUADRIC, th, frame, delta, before)
        delta[k] = 0.0
        (centre, radii, _), (centre_2, radii_2, _) = ellipsoid(before), ellipsoid(after)
        J[:3, k] = (centre_2 - centre) / (2.0 * step[k])
        J[3:, k] = (radii_2 - radii) / (2.0 * step[k])
    return J
