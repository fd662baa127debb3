"""A measurement (eq 13): a squared distance to every possible sensed feature, tied to one object feature."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from fusion.features import Feature, Kind
from hal.arrays import Array
from hal.errors import InvalidRequest

NULL_RATIO = 1e-9  # an eigenvalue of M below this share of the largest one is rounding error


class SensingClass(IntEnum):
    """Class of a measurement: the kind of the sensed feature, then that of the object feature (paper, Fig. 11)."""

    POINT_POINT = 1
    POINT_LINE = 2
    POINT_PLANE = 3
    LINE_POINT = 4
    LINE_LINE = 5
    LINE_PLANE = 6
    PLANE_POINT = 7
    PLANE_LINE = 8
    PLANE_PLANE = 9

    @property
    def words(self) -> str:
        """The paper's descriptor, for example `line-point`."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def of(cls, sensed: Kind, on_object: Kind) -> SensingClass:
        """Return the class of a sensed `point`, `line` or `plane` that belongs to a feature of the object."""
        order = list(Kind)
        return cls(3 * order.index(sensed) + order.index(on_object) + 1)

    @classmethod
    def named(cls, words: str) -> SensingClass:
        """Return the class with that descriptor; the inverse of `words`.

        Raises:
            InvalidRequest: no such class.
        """
        for member in cls:
            if member.words == words:
                return member
        raise InvalidRequest(f"no sensing class {words!r}", hint=f"one of {[m.words for m in cls]}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """One sensing of one object feature: `g(y, v) = (y - mu)^T C^-1 (y - mu) + v^T M v`, |v| = 1 (eq 13).

    Attributes:
        cls: sensing class.
        x_m: (3,) point of the object feature, object frame, m.
        u: (3,) unit direction or normal of the object feature, object frame; ignored for a point.
        mu_m: (3,) the sensed point, or the place on the sensed line or plane that is known best, base frame, m.
        C_m2: (3, 3) its covariance, m^2; symmetric positive definite.
        M: (3, 3) information of the sensed direction, 1/rad^2; positive semidefinite, its null direction is the measured
            one. Zero when a point was sensed.
        label: how reports call it.
        sensor: which device or sense it came from.
        part: which part of a shape with unknown dimensions it belongs to (`fusion.shapes`); empty for a fixed feature.
    """

    cls: SensingClass
    x_m: Array
    u: Array
    mu_m: Array
    C_m2: Array
    M: Array
    label: str = ""
    sensor: str = ""
    part: str = ""

    @property
    def dof(self) -> int:
        """Degrees of freedom of the chi-square distribution of the local pose function at the true pose."""
        values = np.linalg.eigvalsh(self.M)
        return constraints_of(self.cls, int(np.sum(values[1:] > NULL_RATIO * values[2])))


def measurement(
    feature: Feature,
    sensed: Kind,
    *,
    mu_m: ArrayLike,
    C_m2: ArrayLike,
    M: ArrayLike | None = None,
    label: str = "",
    sensor: str = "",
) -> Measurement:
    """Return a measurement of `feature` by a sensor of points, lines or planes; shapes and units as `Measurement`."""
    return Measurement(
        cls=SensingClass.of(sensed, feature.kind),
        x_m=feature.point_m,
        u=feature.direction,
        mu_m=np.asarray(mu_m, float),
        C_m2=np.asarray(C_m2, float),
        M=np.zeros((3, 3)) if M is None else np.asarray(M, float),
        label=label or f"{sensed}-{feature.kind} {feature.name}".strip(),
        sensor=sensor,
    )


def constraints_of(cls: int, rank: int) -> int:
    """Return the number of constraints of a class when `rank` of the two direction errors are known."""
    rank = min(rank, 2)
    return {1: 3, 2: 2, 3: 1, 4: rank, 5: 2 + rank, 6: 1 + max(rank - 1, 0), 7: max(rank - 1, 0), 8: rank, 9: 1 + rank}[
        cls
    ]
