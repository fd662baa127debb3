"""What fusion answers: the pose, how well it is known, what was not believed, what else fits."""

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
from fusion.robust.minima import Minimum
from fusion.solve.local import LocalSolution
from fusion.solve.observability import FreeDirection
from hal.arrays import Array
from hal.geometry import UncertainPose

EVIDENCE_NEEDED = math.log(1000.0)  # for agreement against chance, once something was rejected
EVIDENCE_PER_MISMATCH = 0.5  # each rejected measurement is a surprise: fewer are bad than good
ONE_IN = 1e5
NO_NOISE = 1e-9  # a chi-square per degree of freedom that no sensor's noise gives, in whatever unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Proofs:
    """What to prove beside the answer: the certificate, and the best set within so many seconds (None: not)."""

    certificate: bool = False
    set_within_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rejected:
    """A measurement that was not used.

    Attributes:
        index: its place in the sequence given; -1 for the prior pose.
        label: its label.
        value: its local pose function at the answer.
        limit: what a good one stays below.
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
        cost: its truncated error; the answer's is the least.
        odds: how probable it is relative to the answer, 0 to 1.
        rejected: indices that it calls mismatched.
    """

    pose: RigidTransform
    covariance: Array
    cost: float
    odds: float
    rejected: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeEstimate:
    """Measures of an object that were estimated with its pose.

    Attributes:
        names: of the measures, with their units.
        values: (P,) estimates.
        covariance: (P, P) of them, the pose unknown.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def sigma_of(self, name: str) -> float:
        """Standard deviation of one measure."""
        k = self.names.index(name)
        return math.sqrt(self.covariance[k, k])

    def value_of(self, name: str) -> float:
        """One measure."""
        return float(self.values[self.names.index(name)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedPose:
    """Where the object stands, and how well that is known.

    Attributes:
        pose: base_from_object.
        covariance: 6x6 over (dx, dy, dz, rx, ry, rz), m and rad, base axes; free directions carry 10 object sizes or 10 rad.
        chi_square: sum of the local pose functions of the measurements used.
        dof: its degrees of freedom.
        values: (N,) local pose function of every measurement given, at `pose`.
        rejected: measurements not used, and why.
        unobservable: motions that the measurements leave free; empty for a full pose.
        alternatives: other poses that fit, most probable first.
        evidence: log odds that the measurements used agree because of the pose, against chance.
        certificate: proof that no other pose fits those measurements better, when asked for.
        proven_set: the set of measurements with the least truncated error, with proof, when asked for.
        shape: the object's own measures, when it was given as a shape with unknown ones.
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
        """Do the measurements agree better than noise of the stated size lets them, but for once in `ONE_IN` times?

        Variances in mm^2 that are taken for m^2 make the chi-square a million times too small. Examples drawn by hand agree
        exactly and are not meant.
        """
        if self.dof < 1 or self.chi_square < NO_NOISE * self.dof:
            return False
        return bool(chdtr(self.dof, self.chi_square) * ONE_IN <= 1.0)

    @property
    def base_from_object(self) -> UncertainPose:
        """The pose with its covariance, as the rest of the cell takes it."""
        return UncertainPose(parent_from_child=self.pose, covariance=self.covariance)

    @property
    def is_ambiguous(self) -> bool:
        """True when another pose is at least a hundredth as probable."""
        return any(a.odds > 0.01 for a in self.alternatives)


def judged(
    b: Batch,
    best: Minimum,
    others: Sequence[Minimum],
    index: NDArray[np.int64],
    given: Sequence[Measurement],
    repeats: dict[int, int],
    proofs: Proofs,
) -> FusedPose:
    """The answer that a best minimum and the `others` make.

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
    """What an answer says of its measurements: value of each (N,), those not used, and the evidence for the others.

    Args:
        b: packed measurements; `index` says which of `given` each entry is, -1 for the prior.
        used: which entries the `local` solution stems from.
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


def _alternatives(best: Minimum, others: Sequence[Minimum], index: NDArray[np.int64]) -> tuple[Alternative, ...]:
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


def _odds(m: Minimum, best: Minimum) -> float:
    """exp(-delta/2) sqrt(det cov / det cov_best): share of the posterior around each (Laplace)."""
    size = np.linalg.slogdet(m.local.covariance)[1] - np.linalg.slogdet(best.local.covariance)[1]
    return float(np.exp(min(0.5 * (best.cost - m.cost) + 0.5 * size, 0.0)))
