"""Chooses the next sensing: the possible one that reduces the uncertainty of the pose most per second.

The information of a sensing at the estimated pose is known before it is made, because it depends on the geometry and
not on the reading; so do the errors that it shares with earlier readings (`fusion.shared_errors`). The criterion is the
mean square error of the pose in units of the task's tolerance: 1 is "on average just tolerable".

Source: V. V. Fedorov, Theory of Optimal Experiments, Academic Press 1972, ch. 2: sequential design, A-optimality.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.shared_errors import ErrorBudget
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import matrix_of, skew

LEAST_GAIN = 0.01  # of the pose's mean square error; a touch with a smaller expected gain is not made
TOUCH_S = 2.0  # duration of hovering, approaching and leaving, without the motion between places


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseTolerance:
    """Tolerance of a pose: standard deviations of position and angle over all axes, and the point where it applies."""

    position_m: float = 0.0015  # half of what the skills tolerate, so that two sigma suffice
    angle_rad: float = 0.002  # six tenths of a millimetre over half the width of a panel
    at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def error_of(self, covariance: Array, base_from_object: RigidTransform) -> float:
        """Return the mean square error of a pose in units of this tolerance, half of it position and half angle.

        Args:
            covariance: (6, 6) translation then rotation, base axes, m and rad.
            base_from_object: the pose itself.
        """
        lever = matrix_of(base_from_object) @ np.asarray(self.at_m, float)
        J = np.hstack([np.eye(3), -skew(lever)])  # error of the point at which the tolerance applies
        at_place = float(np.trace(J @ covariance @ J.T))
        turned = float(np.trace(covariance[3:, 3:]))
        return 0.5 * (at_place / self.position_m**2 + turned / self.angle_rad**2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CandidateSensing:
    """A sensing that could be made.

    Attributes:
        budget: the information of its observations, with the errors that they share with others.
        cost_s: its duration, s.
    """

    budget: ErrorBudget
    cost_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SensingChoice:
    """The candidate chosen.

    Attributes:
        index: its place among the candidates given.
        error_before, error_after: mean square error in units of the tolerance, now and as expected after the sensing.
        gain_per_s: log(error_before / error_after) per second of its cost.
    """

    index: int
    error_before: float
    error_after: float
    gain_per_s: float


def next_measurement(
    budget: ErrorBudget,
    base_from_object: RigidTransform,
    candidates: Sequence[CandidateSensing],
    *,
    tolerance: PoseTolerance | None = None,
) -> SensingChoice:
    """Return the candidate that reduces the pose's error most per second.

    Args:
        budget: of the observations so far.
        base_from_object: the present estimate of the pose.
        candidates: the possible sensings.
        tolerance: the accuracy wanted.

    Raises:
        InvalidRequest: no candidate, or a cost that is not positive.
    """
    if not candidates:
        raise InvalidRequest("no candidate sensing", hint="offer at least one")
    for i, candidate in enumerate(candidates):
        if not candidate.cost_s > 0.0:
            raise InvalidRequest(f"candidate {i} costs {candidate.cost_s} s", hint="a cost is a positive time", index=i)
    wanted = tolerance or PoseTolerance()
    before = wanted.error_of(budget.covariance, base_from_object)
    after = [wanted.error_of(budget.plus(candidate.budget).covariance, base_from_object) for candidate in candidates]
    gains = [np.log(before / error) / c.cost_s for error, c in zip(after, candidates, strict=True)]
    best = int(np.argmax(gains))
    return SensingChoice(index=best, error_before=before, error_after=after[best], gain_per_s=float(gains[best]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TouchPlan:
    """The present information about the pose, and the places that could be touched next.

    Attributes:
        base_from_panel: estimated pose.
        budget: error budget of all observations so far.
        tolerance: wanted accuracy of the pose.
        spots_m: (N, 2) remaining places, panel frame, those that are farthest apart first.
        offers: expected error budget of a touch at each of them.
        places: the first so many places may be chosen; the others replace those that cannot be touched.
        tip_m: (2,) position of the fingertips, panel frame.
        speed_m_per_s: speed of the tips between places.
    """

    base_from_panel: RigidTransform
    budget: ErrorBudget
    tolerance: PoseTolerance
    spots_m: Array
    offers: tuple[ErrorBudget, ...]
    places: int
    tip_m: Array
    speed_m_per_s: float

    @property
    def error(self) -> float:
        """Mean square error of the pose in units of the tolerance."""
        return self.tolerance.error_of(self.budget.covariance, self.base_from_panel)

    def choice(self) -> SensingChoice | None:
        """Return the place to touch next, or None when no place is left."""
        offers, spots_m = self.offers[: self.places], self.spots_m[: self.places]
        if not offers:
            return None
        ways_m = np.linalg.norm(spots_m - self.tip_m, axis=1)
        candidates = [
            CandidateSensing(budget=offer, cost_s=TOUCH_S + float(way_m) / self.speed_m_per_s)
            for offer, way_m in zip(offers, ways_m, strict=True)
        ]
        return next_measurement(self.budget, self.base_from_panel, candidates, tolerance=self.tolerance)

    def without(self, index: int) -> Self:
        """Return the plan without a place."""
        left = [k for k in range(len(self.offers)) if k != index]
        return replace(self, spots_m=self.spots_m[left], offers=tuple(self.offers[k] for k in left))

    def after(self, index: int, told: ErrorBudget) -> Self:
        """Return the plan after a place was touched, with `told` the error budget of its readings."""
        budget, tip_m = self.budget.plus(told), self.spots_m[index]
        return replace(self.without(index), budget=budget, places=self.places - 1, tip_m=tip_m)

    def reason_to_stop(self, choice: SensingChoice | None) -> str:
        """Why no further place needs to be touched; empty when one does."""
        if self.error <= 1.0:
            return "the pose is as good as wanted"
        if choice is None:
            return "no place is left"
        if choice.error_after > (1.0 - LEAST_GAIN) * choice.error_before:
            return f"no further touch is expected to lower the pose's mean square error by {100 * LEAST_GAIN:.0f} %"
        return ""
