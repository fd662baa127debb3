"""The result of fusion: the pose, its covariance, the rejected measurements, and alternative poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtr

from fusion.batch import Batch
from fusion.certify.proof import Certificate, certificate
from fusion.errors import Contradiction
from fusion.measurement import Measurement
from fusion.robust.evidence import log_evidence
from fusion.robust.inliers import ProvenSet, best_set
from fusion.robust.minima import PoseMinimum
from fusion.solve.local import LocalSolution
from fusion.solve.observability import FreeDirection
from hal.arrays import Array
from hal.geometry import UncertainPose

EVIDENCE_NEEDED = math.log(1000.0)  # least log odds of agreement against chance, if a measurement was rejected
EVIDENCE_PER_MISMATCH = 0.5  # added per rejected measurement, because bad ones are less frequent than good ones
ONE_IN = 1e5
NO_NOISE = 1e-9  # a chi-square per degree of freedom too small for any sensor's noise, in any unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Proofs:
    """The wanted proofs: the certificate, and the best set within `set_within_s` seconds (None for no proof)."""

    certificate: bool = False
    set_within_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rejected:
    """A measurement that was not used.

    Attributes:
        index: its index in the sequence given; -1 for the prior pose.
        label: its label.
        value: its local pose function at the estimated pose.
        limit: upper limit of that value for a good measurement.
        reason: `mismatch`, or `duplicate of measurement 3`.
    """

    index: int
    label: str
    value: float
    limit: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Another pose that the data allow, for example the mirror image.

    Attributes:
        pose: base_from_object.
        covariance: 6x6, translation then rotation, base axes.
        cost: its truncated error; the estimate has the least.
        odds: its probability relative to the estimate, 0 to 1.
        rejected: indices of the measurements that it rejects.
    """

    pose: RigidTransform
    covariance: Array
    cost: float
    odds: float
    rejected: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeEstimate:
    """Dimensions of an object that were estimated with its pose.

    Attributes:
        names: of the dimensions, with their units.
        values: (P,) estimates.
        covariance: (P, P) of the estimates, with the pose unknown.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def sigma_of(self, name: str) -> float:
        """Return the standard deviation of one dimension."""
        k = self.names.index(name)
        return math.sqrt(self.covariance[k, k])

    def value_of(self, name: str) -> float:
        """Return one dimension."""
        return float(self.values[self.names.index(name)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedPose:
    """Estimated pose of the object, with its covariance.

    Attributes:
        pose: base_from_object.
        covariance: 6x6 over (dx, dy, dz, rx, ry, rz), m and rad, base axes; free directions have 10 sizes or rad.
        chi_square: sum of the local pose functions of the measurements used.
        dof: its degrees of freedom.
        values: (N,) local pose function of every measurement given, at `pose`.
        rejected: measurements not used, and why.
        unobservable: motions that the measurements leave free; empty for a full pose.
        alternatives: other poses that fit, most probable first.
        evidence: log odds that the measurements used agree because of the pose, against chance.
        certificate: proof that no other pose fits those measurements better, when asked for.
        proven_set: the set of measurements with the least truncated error, with proof, when asked for.
        shape: the estimated dimensions of the object, if it was given as a shape.
    """

    pose: RigidTransform
    covariance: Array
    chi_square: float
    dof: int
    values: Array
    rejected: tuple[Rejected, ...]
    unobservable: tuple[FreeDirection, ...]
    alternatives: tuple[Alternative, ...]
    evidence: float
    certificate: Certificate | None = None
    proven_set: ProvenSet | None = None
    shape: ShapeEstimate | None = None

    @property
    def agrees_too_well(self) -> bool:
        """Whether the measurements agree better than their stated noise allows, except once in `ONE_IN` cases.

        Variances in mm^2 that are taken for m^2 make the chi-square a million times too small. Constructed examples
        agree exactly and are not reported.
        """
        if self.dof < 1 or self.chi_square < NO_NOISE * self.dof:
            return False
        return bool(chdtr(self.dof, self.chi_square) * ONE_IN <= 1.0)

    @property
    def base_from_object(self) -> UncertainPose:
        """The pose with its covariance, as the rest of the cell uses it."""
        return UncertainPose(parent_from_child=self.pose, covariance=self.covariance)

    @property
    def is_ambiguous(self) -> bool:
        """Whether another pose is at least a hundredth as probable."""
        return any(a.odds > 0.01 for a in self.alternatives)


def judged(
    b: Batch,
    best: PoseMinimum,
    others: Sequence[PoseMinimum],
    index: NDArray[np.int64],
    given: Sequence[Measurement],
    repeats: dict[int, int],
    proofs: Proofs,
) -> FusedPose:
    """Return the result for a best minimum and the `others`.

    Args:
        b: packed measurements; `index` (N,) says which of `given` each entry is, -1 for the prior.
        best, others: distinct minima of the truncated error.
        given: all measurements of the caller.
        repeats: index of each duplicate, and of the measurement that it repeats.
        proofs: what else to prove.

    Raises:
        Contradiction: the best set could agree by chance.
    """
    local = best.local
    values, rejected, evidence = weighed(b, best.used, local, index, given, repeats)
    return FusedPose(
        pose=local.base_from_object,
        covariance=local.covariance,
        chi_square=local.chi_square,
        dof=local.dof,
        values=values,
        rejected=rejected,
        unobservable=local.unobservable,
        alternatives=() if local.unobservable else _alternatives(best, others, index),
        evidence=evidence,
        certificate=certificate(b, best.used, local) if proofs.certificate else None,
        proven_set=best_set(b, best.used, local, index, deadline_s=proofs.set_within_s)
        if proofs.set_within_s is not None
        else None,
    )


def weighed(
    b: Batch,
    used: NDArray[np.bool_],
    local: LocalSolution,
    index: NDArray[np.int64],
    given: Sequence[Measurement],
    repeats: dict[int, int],
) -> tuple[Array, tuple[Rejected, ...], float]:
    """Return the value of each measurement (N,), the rejected ones, and the evidence for the others.

    Args:
        b: packed measurements; `index` says which of `given` each entry is, -1 for the prior.
        used: which entries the `local` solution is computed from.
        given: all measurements of the caller.
        repeats: index of each duplicate, and of the measurement that it repeats.

    Raises:
        Contradiction: the measurements used could agree by chance.
    """
    values = np.zeros(len(given))
    own = index >= 0
    values[index[own]] = local.values[own]
    for repeat, first in repeats.items():
        values[repeat] = values[first]
    mismatched = [
        Rejected(
            index=int(index[k]),
            label=given[index[k]].label if index[k] >= 0 else "prior pose",
            value=float(local.values[k]),
            limit=float(b.gate[k]),
            reason="mismatch",
        )
        for k in np.flatnonzero(~used)
    ]
    evidence = log_evidence(b, used, local)
    if mismatched and evidence < EVIDENCE_NEEDED + EVIDENCE_PER_MISMATCH * len(mismatched):
        raise Contradiction.among(int(used.sum()), len(b.cls), [(r.index, r.label, r.value) for r in mismatched])
    repeated = [
        Rejected(
            index=i, label=given[i].label, value=float(values[i]), limit=0.0, reason=f"duplicate of measurement {first}"
        )
        for i, first in repeats.items()
    ]
    return values, tuple(sorted([*mismatched, *repeated], key=lambda r: r.index)), evidence


def _alternatives(
    best: PoseMinimum, others: Sequence[PoseMinimum], index: NDArray[np.int64]
) -> tuple[Alternative, ...]:
    made = [
        Alternative(
            pose=m.local.base_from_object,
            covariance=m.local.covariance,
            cost=m.cost,
            odds=_odds(m, best),
            rejected=tuple(int(i) for i in index[~m.used]),
        )
        for m in others
        if not m.local.unobservable
    ]
    return tuple(sorted(made, key=lambda a: -a.odds))


def _odds(m: PoseMinimum, best: PoseMinimum) -> float:
    """Return exp(-delta/2) sqrt(det cov / det cov_best), the ratio of the posterior masses around both (Laplace)."""
    size = np.linalg.slogdet(m.local.covariance)[1] - np.linalg.slogdet(best.local.covariance)[1]
    return float(np.exp(min(0.5 * (best.cost - m.cost) + 0.5 * size, 0.0)))
