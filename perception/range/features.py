"""Points, lines and planes with covariance, for fusion.

A feature is a point with a (3, 3) covariance and, for lines and planes, a unit vector with a (3, 3) covariance whose
null direction is the vector itself: the `C` and `M^-1` of the fusion measurements (paper, Section IV).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hal.arrays import Array
from perception.range.primitives import Cone, Cylinder, Ellipsoid, Plane, Sphere, Surface

LEAST_CREASE_RAD = 0.15  # planes at a smaller angle intersect in a line that is mostly determined by noise


class FeatureKind(StrEnum):
    """Geometric type of a feature."""

    POINT = "point"
    LINE = "line"
    PLANE = "plane"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeFeature:
    """A measured feature in the sensor frame.

    Attributes:
        point_m: (3,) the point; of a plane or line, its point nearest the middle of the data.
        point_covariance: (3, 3) m^2; zero along a line and in a plane, where a shift of the point is no error.
        direction: (3,) unit direction of a line or normal of a plane (towards the sensor); zeros for a point.
        direction_covariance: (3, 3) rad^2, null direction `direction`; zeros for a point.
        labels: labels of the surfaces from which it was computed.
    """

    kind: FeatureKind
    point_m: Array
    point_covariance: Array
    direction: Array
    direction_covariance: Array
    labels: tuple[int, ...]

    @property
    def sigma_point_m(self) -> float:
        """Largest standard deviation of the point, metres; for a plane that of its offset along the normal."""
        return float(np.sqrt(np.linalg.eigvalsh(self.point_covariance)[-1]))

    @property
    def sigma_angle_rad(self) -> float:
        """Largest standard deviation of the direction, radians."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.direction_covariance)[-1], 0.0)))


def plane_feature(surface: Surface) -> RangeFeature:
    """Return the plane of a planar surface, with the covariances of its offset (at its middle point) and normal."""
    plane = surface.primitive
    if not isinstance(plane, Plane):
        raise TypeError(f"surface {surface.label} is a {surface.type}, not a plane")
    n, frame, C = plane.normal, surface.frame, surface.covariance
    # The plane is n . X = d. Near `point` a change of n and d shifts it by delta d - point . delta n.
    row = np.array([-frame[0] @ plane.point_m, -frame[1] @ plane.point_m, 1.0])
    return RangeFeature(
        kind=FeatureKind.PLANE,
        point_m=plane.point_m,
        point_covariance=float(row @ C @ row) * np.outer(n, n),
        direction=n,
        direction_covariance=frame.T @ C[:2, :2] @ frame,
        labels=(surface.label,),
    )


def axis_feature(surface: Surface) -> RangeFeature:
    """Return the axis of a cylinder or cone as a line."""
    shape, frame, C = surface.primitive, surface.frame, surface.covariance
    if isinstance(shape, Cylinder):
        # The covariance of the shifts refers to the fit's own reference point; the lever of a tilt between that point and
        # `point_m` is neglected.
        return RangeFeature(
            kind=FeatureKind.LINE,
            point_m=shape.point_m,
            point_covariance=frame.T @ C[:2, :2] @ frame,
            direction=shape.axis,
            direction_covariance=frame.T @ C[2:4, 2:4] @ frame,
            labels=(surface.label,),
        )
    if isinstance(shape, Cone):
        across = np.eye(3) - np.outer(shape.axis, shape.axis)
        return RangeFeature(
            kind=FeatureKind.LINE,
            point_m=shape.apex_m,
            point_covariance=across @ C[:3, :3] @ across,
            direction=shape.axis,
            direction_covariance=frame.T @ C[3:5, 3:5] @ frame,
            labels=(surface.label,),
        )
    raise TypeError(f"surface {surface.label} is a {surface.type}: it has no axis")


def point_feature(surface: Surface) -> RangeFeature:
    """Return the centre of a sphere or ellipsoid, or the apex of a cone."""
    shape, C = surface.primitive, surface.covariance
    if isinstance(shape, Sphere | Ellipsoid):
        point = shape.centre_m
    elif isinstance(shape, Cone):
        point = shape.apex_m
    else:
        raise TypeError(f"surface {surface.label} is a {surface.type}: it has no point of its own")
    return RangeFeature(
        kind=FeatureKind.POINT,
        point_m=point,
        point_covariance=C[:3, :3].copy(),
        direction=np.zeros(3),
        direction_covariance=np.zeros((3, 3)),
        labels=(surface.label,),
    )


def crease_line(a: Surface, b: Surface, near_m: Array | None = None) -> RangeFeature | None:
    """Return the line in which two planes intersect, with covariance; None if they are nearly parallel.

    Its point is the one nearest `near_m` (3,), or nearest the mean of the planes' middles.
    """
    pa, pb = plane_feature(a), plane_feature(b)
    cross = np.cross(pa.direction, pb.direction)
    sine = float(np.linalg.norm(cross))
    if sine < np.sin(LEAST_CREASE_RAD):
        return None
    direction = cross / sine
    near = 0.5 * (a.middle_m + b.middle_m) if near_m is None else near_m

    def solve(n1: Array, o1: float, n2: Array, o2: float) -> Array:
        u = np.cross(n1, n2)
        u /= np.linalg.norm(u)
        rows = np.stack([n1, n2, u])
        return np.asarray(np.linalg.solve(rows, np.array([o1, o2, float(u @ near)])))

    def line(step: Array) -> Array:
        na, nb = pa.direction + step[:3], pb.direction + step[3:6]
        point = solve(na, float(na @ pa.point_m) + step[6], nb, float(nb @ pb.point_m) + step[7])
        u = np.cross(na, nb)
        return np.concatenate([point, u / np.linalg.norm(u)])

    J = _jacobian(line, 8, 1e-6)
    S = np.zeros((8, 8))
    S[:3, :3], S[3:6, 3:6] = pa.direction_covariance, pb.direction_covariance
    S[6, 6], S[7, 7] = np.trace(pa.point_covariance), np.trace(pb.point_covariance)
    C = J @ S @ J.T
    across = np.eye(3) - np.outer(direction, direction)
    return RangeFeature(
        kind=FeatureKind.LINE,
        point_m=line(np.zeros(8))[:3],
        point_covariance=across @ C[:3, :3] @ across,
        direction=direction,
        direction_covariance=across @ C[3:, 3:] @ across,
        labels=(a.label, b.label),
    )


def corner_point(a: Surface, b: Surface, c: Surface) -> RangeFeature | None:
    """Return the point in which three planes intersect, with covariance; None if their normals are nearly coplanar."""
    planes = [plane_feature(s) for s in (a, b, c)]
    N = np.stack([p.direction for p in planes])
    if np.linalg.svd(N, compute_uv=False)[-1] < np.sin(LEAST_CREASE_RAD):
        return None
    offsets = np.array([p.direction @ p.point_m for p in planes])
    point = np.linalg.solve(N, offsets)
    inverse = np.linalg.inv(N)
    # n_i . X = n_i . p_i + o_i: dX = N^-1 (do_i - dn_i . (X - p_i))
    variance = np.array(
        [
            np.trace(p.point_covariance) + (point - p.point_m) @ p.direction_covariance @ (point - p.point_m)
            for p in planes
        ]
    )
    return RangeFeature(
        kind=FeatureKind.POINT,
        point_m=point,
        point_covariance=inverse @ np.diag(variance) @ inverse.T,
        direction=np.zeros(3),
        direction_covariance=np.zeros((3, 3)),
        labels=(a.label, b.label, c.label),
    )


def features_of(surfaces: Iterable[Surface]) -> tuple[RangeFeature, ...]:
    """Return the feature of each surface: a plane, the axis of a cylinder or cone, or the centre of any other."""
    out = []
    for surface in surfaces:
        if isinstance(surface.primitive, Plane):
            out.append(plane_feature(surface))
        elif isinstance(surface.primitive, Cylinder | Cone):
            out.append(axis_feature(surface))
        else:
            out.append(point_feature(surface))
    return tuple(out)


def _jacobian(function, size: int, step: float) -> Array:  # type: ignore[no-untyped-def]  # numba types it
    """Return the Jacobian of a function of `size` variables at zero, by central differences."""
    columns = []
    for k in range(size):
        d = np.zeros(size)
        d[k] = step
        columns.append((function(d) - function(-d)) / (2.0 * step))
    return np.stack(columns, axis=1)
