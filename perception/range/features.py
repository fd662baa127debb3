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
        point, point_covariance, tilts = shape.point_m, frame.T @ C[:2, :2] @ frame, C[2:4, 2:4]
    elif isinstance(shape, Cone):
        across = np.eye(3) - np.outer(shape.axis, shape.axis)
        point, point_covariance, tilts = shape.apex_m, across @ C[:3, :3] @ across, C[3:5, 3:5]
    else:
        raise TypeError(f"surface {surface.label} is a {surface.type}: it has no axis")
    return RangeFeature(
        kind=FeatureKind.LINE,
        point_m=point,
        point_covariance=point_covariance,
        direction=shape.axis,
        direction_covariance=frame.T @ tilts @ frame,
        labels=(surface.label,),
    )


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
