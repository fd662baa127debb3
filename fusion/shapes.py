"""Objects with unknown dimensions: their features depend on parameters, and on where they were touched.

A curved surface is not a point, line or plane, but near a sensed point it is approximated by its tangent plane, which
is a feature like any other. So a cylinder's radius or a box's size is estimated from the same measurements as the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fusion.features import Feature, line, plane
from hal.arrays import Array
from hal.errors import InvalidRequest


class Shape(Protocol):
    """A family of objects.

    Attributes:
        names: of the parameters, with units.
        start: (P,) prior values.
        sigma: (P,) standard deviations of the prior values; make them large to let the measurements decide.
        parts: names of its surfaces and edges.
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def start(self) -> Array: ...

    @property
    def sigma(self) -> Array: ...

    @property
    def parts(self) -> tuple[str, ...]: ...

    def feature(self, part: str, values: Array, place_m: Array) -> Feature:
        """Return the feature of `part` near `place_m` (3,), object frame, when the parameters are `values` (P,)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Cylinder:
    """A round post along z that stands on z = 0: parts `wall` (the mantle) and `top` (the flat end at z = length)."""

    radius_m: float
    length_m: float
    sigma_m: float = 0.02

    @property
    def names(self) -> tuple[str, ...]:
        """Names of radius and length."""
        return ("radius_m", "length_m")

    @property
    def start(self) -> Array:
        """(2,) prior values, m."""
        return np.array([self.radius_m, self.length_m])

    @property
    def sigma(self) -> Array:
        """(2,) standard deviations of the prior values, m."""
        return np.full(2, self.sigma_m)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of its surfaces."""
        return ("wall", "top")

    def feature(self, part: str, values: Array, place_m: Array) -> Feature:
        """Return the tangent plane of the wall next to `place_m`, or the plane of the top.

        Raises:
            InvalidRequest: no such part.
        """
        radius, length = values
        if part == "top":
            return plane((0.0, 0.0, length), (0.0, 0.0, 1.0), name=part)
        if part != "wall":
            raise _no_part(part, self.parts)
        around = np.array([place_m[0], place_m[1], 0.0])
        distance = float(np.linalg.norm(around))
        normal = around / distance if distance > 1e-9 else np.array([1.0, 0.0, 0.0])
        return plane(radius * normal + (0.0, 0.0, place_m[2]), normal, name=part)


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A box about the origin: parts are its faces `+x` to `-z` and the edges between them, for example `+x+z`."""

    size_m: tuple[float, float, float]
    sigma_m: float = 0.02

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lengths along each axis."""
        return ("size_x_m", "size_y_m", "size_z_m")

    @property
    def start(self) -> Array:
        """(3,) prior values, m."""
        return np.array(self.size_m)

    @property
    def sigma(self) -> Array:
        """(3,) standard deviations of the prior values, m."""
        return np.full(3, self.sigma_m)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of its faces and edges."""
        faces = [sign + axis for axis in "xyz" for sign in "+-"]
        return (*faces, *(a + b for a in faces for b in faces if a[1] < b[1]))

    def feature(self, part: str, values: Array, place_m: Array) -> Feature:  # noqa: ARG002 - flat faces are flat everywhere
        """Return a face's plane or an edge's line.

        Raises:
            InvalidRequest: no such part.
        """
        if part not in self.parts:
            raise _no_part(part, self.parts)
        point, axes = np.zeros(3), []
        for sign, axis in zip(part[::2], part[1::2], strict=True):
            k = "xyz".index(axis)
            point[k] = values[k] / 2 if sign == "+" else -values[k] / 2
            axes.append(np.eye(3)[k] if sign == "+" else -np.eye(3)[k])
        return plane(point, axes[0], name=part) if len(axes) == 1 else line(point, np.cross(*axes), name=part)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingPart:
    """A feature whose position depends on the parameters: point_m + slopes^T values.

    Attributes:
        feature: the feature when all parameters are zero.
        slopes: (P, 3) displacement of its point per unit of each parameter, object frame.
    """

    feature: Feature
    slopes: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureSet:
    """Points, lines and planes whose positions are linear in parameters: a hinge's gap, a slider's travel, a pitch.

    Attributes:
        names, start, sigma: as `Shape`.
        moving: the parts by name.
    """

    names: tuple[str, ...]
    start: Array
    sigma: Array
    moving: dict[str, MovingPart]

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of its features."""
        return tuple(self.moving)

    def feature(self, part: str, values: Array, place_m: Array) -> Feature:  # noqa: ARG002 - these features are flat everywhere
        """Return the part's feature at these parameters.

        Raises:
            InvalidRequest: no such part.
        """
        if part not in self.moving:
            raise _no_part(part, self.parts)
        found = self.moving[part]
        return replace(found.feature, point_m=found.feature.point_m + np.asarray(values) @ found.slopes)


def _no_part(part: str, parts: tuple[str, ...]) -> InvalidRequest:
    return InvalidRequest(f"the shape has no part {part!r}", hint=f"one of {', '.join(parts)}")
