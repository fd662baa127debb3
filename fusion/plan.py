"""What to sense next: of the sensings that could be made, the one that tells most per second.

A sensing that would be made at the believed pose has a known information matrix before it is made (its covariance depends on the
geometry, not on the reading), so the covariance after it is known too. The measure is the mean square error of the pose in units
of what the task tolerates: 1 is "on average just tolerable".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from fusion.batch import pack
from fusion.distance.rows import informations
from fusion.features import Feature, Kind
from fusion.measurement import Measurement, measurement
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import matrix_of, skew


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A sensing that could be made.

    Attributes:
        expected: the measurement that it would give at the believed pose; see `expected_measurement`.
        cost_s: time that it takes, s.
    """

    expected: Measurement
    cost_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """What the task forgives: position and angle, one standard deviation over all axes, and where on the object."""

    position_m: float = 0.001
    angle_rad: float = float(np.radians(0.2))
    at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Choice:
    """A candidate chosen.

    Attributes:
        index: its place among the candidates given.
        covariance: 6x6 after it, translation then rotation, base axes.
        error_before, error_after: mean square error in units of the tolerance.
        gain_per_s: by how much the error shrinks in each second spent, relative: log(before / after) / cost.
    """

    index: int
    covariance: Array
    error_before: float
    error_after: float
    gain_per_s: float


def expected_measurement(
    feature: Feature,
    sensed: Kind,
    base_from_object: RigidTransform,
    *,
    C_m2: ArrayLike,
    M: ArrayLike | None = None,
    mu_m: ArrayLike | None = None,
    label: str = "",
    sensor: str = "",
) -> Measurement:
    """The measurement that sensing `feature` at the believed pose would give without noise.

    Args:
        feature: what would be sensed, object frame.
        sensed: what the sensor reports: point, line or plane.
        base_from_object: the believed pose.
        C_m2, M: as `Measurement`.
        mu_m: (3,) where the sensed line or plane is known best, for example the lens; by default at the feature.
    """
    place = base_from_object.apply(feature.point_m) if mu_m is None else np.asarray(mu_m, float)
    return measurement(feature, sensed, mu_m=place, C_m2=C_m2, M=M, label=label, sensor=sensor)


def next_best(
    covariance: ArrayLike,
    base_from_object: RigidTransform,
    candidates: Sequence[Candidate],
    *,
    tolerance: Tolerance | None = None,
) -> Choice:
    """The candidate that shrinks the error most per second.

    Args:
        covariance: 6x6 of the pose now, translation then rotation, base axes.
        base_from_object: the pose now.
        candidates: what could be sensed.
        tolerance: what the task needs; 1 mm and 0.2 degrees at the object's origin by default.

    Raises:
        InvalidRequest: no candidate, a cost that is not positive, or a measurement that makes no sense.
    """
    if not candidates:
        raise InvalidRequest("no candidate sensing", hint="offer at least one")
    for i, c in enumerate(candidates):
        if not c.cost_s > 0.0:
            raise InvalidRequest(f"candidate {i} costs {c.cost_s} s", hint="a cost is a positive time", index=i)
    now = np.asarray(covariance, float)
    W = _weights(base_from_object, tolerance or Tolerance())
    before = float(np.trace(W @ now))
    added = _informations([c.expected for c in candidates], base_from_object)
    after = [np.linalg.inv(np.linalg.inv(now) + J) for J in added]
    errors = [float(np.trace(W @ covariance)) for covariance in after]
    gains = [np.log(before / error) / c.cost_s for error, c in zip(errors, candidates, strict=True)]
    best = int(np.argmax(gains))
    return Choice(
        index=best, covariance=after[best], error_before=before, error_after=errors[best], gain_per_s=gains[best]
    )


def plan(
    covariance: ArrayLike,
    base_from_object: RigidTransform,
    candidates: Sequence[Candidate],
    *,
    tolerance: Tolerance | None = None,
    enough: float = 1.0,
) -> list[Choice]:
    """Sensings in order, each the best after those before, until the error is at most `enough`. None is used twice.

    Raises:
        InvalidRequest: as `next_best`.
    """
    left, chosen, now = list(range(len(candidates))), list[Choice](), np.asarray(covariance, float)
    error = float(np.trace(_weights(base_from_object, tolerance or Tolerance()) @ now))
    while left and error > enough:
        step = next_best(now, base_from_object, [candidates[i] for i in left], tolerance=tolerance)
        chosen.append(
            Choice(
                index=left.pop(step.index), covariance=step.covariance, error_before=step.error_before,
                error_after=step.error_after, gain_per_s=step.gain_per_s,
            )
        )  # fmt: skip
        now, error = step.covariance, step.error_after
    return chosen


def _informations(measurements: Sequence[Measurement], pose: RigidTransform) -> Array:
    """(N, 6, 6) information of each measurement alone, at a pose."""
    found = np.zeros((len(measurements), 6, 6))
    R, t = np.array(matrix_of(pose), order="C"), np.array(pose.translation, order="C")
    informations(pack(measurements), R, t, found)
    return found


def _weights(pose: RigidTransform, tolerance: Tolerance) -> Array:
    """W with trace(W covariance) = half of (position error / tolerance)^2 + half of (angle error / tolerance)^2."""
    lever = matrix_of(pose) @ np.asarray(tolerance.at_m, float)
    J = np.hstack([np.eye(3), -skew(lever)])  # of the place that matters
    turn = np.hstack([np.zeros((3, 3)), np.eye(3)])
    return np.asarray(0.5 * (J.T @ J / tolerance.position_m**2 + turn.T @ turn / tolerance.angle_rad**2))
