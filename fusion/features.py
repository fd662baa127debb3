"""Points, lines and planes: the features of an object, and what a sensor reports (paper section IV-B-1)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.errors import InvalidRequest


class Kind(StrEnum):
    """Kind of a feature by its dimension: a point has none, a line has one, a plane has two."""

    POINT = "point"
    LINE = "line"
    PLANE = "plane"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Feature:
    """One point, line or plane of an object, in the object frame.

    Attributes:
        kind: point, line or plane.
        point_m: (3,) the point itself, or any point on the line or plane, metres.
        direction: (3,) unit vector along the line or normal to the plane (either sense); without meaning for a point.
        name: its name in reports.
    """

    kind: Kind
    point_m: Array
    direction: Array
    name: str = ""


def unit(direction: ArrayLike, what: str = "direction") -> Array:
    """Return `direction` (3,) scaled to length one.

    Raises:
        InvalidRequest: not three finite numbers, or (almost) zero.
    """
    v = np.asarray(direction, float)
    if v.shape != (3,) or not np.isfinite(v).all():
        raise InvalidRequest(f"{what} must be three finite numbers", hint="give a vector (x, y, z)")
    length = float(np.linalg.norm(v))
    if length < 1e-9:
        raise InvalidRequest(f"{what} is zero", hint="a line or plane needs a direction of any non-zero length")
    return v / length


def _place(point_m: ArrayLike) -> Array:
    p = np.asarray(point_m, float)
    if p.shape != (3,) or not np.isfinite(p).all():
        raise InvalidRequest("a feature's point must be three finite numbers", hint="give (x, y, z) in metres")
    return p


def point(point_m: ArrayLike, *, name: str = "") -> Feature:
    """Return a point feature: a vertex, a small hole, a light. `point_m`: (3,) in the object frame."""
    return Feature(kind=Kind.POINT, point_m=_place(point_m), direction=np.array([0.0, 0.0, 1.0]), name=name)


def line(point_m: ArrayLike, direction: ArrayLike, *, name: str = "") -> Feature:
    """Return a line feature: an edge through `point_m` (3,) along `direction` (3,), object frame."""
    return Feature(kind=Kind.LINE, point_m=_place(point_m), direction=unit(direction), name=name)


def plane(point_m: ArrayLike, normal: ArrayLike, *, name: str = "") -> Feature:
    """Return a plane feature: a face through `point_m` (3,) with `normal` (3,), object frame."""
    return Feature(kind=Kind.PLANE, point_m=_place(point_m), direction=unit(normal), name=name)


def box_features(low_m: ArrayLike, high_m: ArrayLike, *, name: str = "box") -> tuple[Feature, ...]:
    """Return the 8 vertices, 12 edges and 6 faces of an axis-aligned box from `low_m` to `high_m`, (3,) each."""
    low, high = _place(low_m), _place(high_m)
    middle, axes = (low + high) / 2, np.eye(3)
    found = [
        point([(low, high)[a][0], (low, high)[b][1], (low, high)[c][2]], name=f"{name} vertex {a}{b}{c}")
        for a in (0, 1)
        for b in (0, 1)
        for c in (0, 1)
    ]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for a in (0, 1):
            for b in (0, 1):
                on_edge = middle.copy()
                on_edge[i], on_edge[j] = (low, high)[a][i], (low, high)[b][j]
                found.append(line(on_edge, axes[k], name=f"{name} edge {'xyz'[k]}{a}{b}"))
        for a, sign in ((0, -1.0), (1, 1.0)):
            on_face = middle.copy()
            on_face[k] = (low, high)[a][k]
            found.append(plane(on_face, sign * axes[k], name=f"{name} face {'-+'[a]}{'xyz'[k]}"))
    return tuple(found)
