"""The one entry point: from measurements, some of them wrong, to a pose that says what it knows (paper IV, issue 3).

Cost: sum min(f_i, gate_i), a truncated squared error whose gate passes 99.9 % of good measurements. Its minimum is sought from
random small subsets (`fusion.search`), finished on the exact functions, and then judged: what else fits, what stays free, and
whether those that agree could do so by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import search
from fusion.certify import Certificate, certificate
from fusion.errors import Contradiction
from fusion.evidence import log_evidence
from fusion.measurement import Batch, Measurement, checked, duplicates, pack
from fusion.observability import FreeDirection
from fusion.solve import LocalSolution, local_solution
from hal.errors import InvalidRequest
from hal.geometry import Array, UncertainPose, matrix_of

MOST_SEARCHED = 96  # measurements that the search looks at; the finish uses all
HYPOTHESES = 6000  # at most
FIRST_ROUND = 48
MISS_PROBABILITY = 1e-5  # of never drawing a clean subset that also converges
CONVERGES = 0.25  # share of clean subsets that reach their pose from a random rotation (measured 0.35)
SETTLED_PER_ROUND = 8
ALTERNATIVE_COST = 18.0  # a minimum this much worse has odds below 1e-4
SAME_SIGMAS = 6.0  # minima closer than this are one
EVIDENCE_NEEDED = math.log(1000.0)


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
        base_from_object: the pose.
        covariance: 6x6, translation then rotation, base axes.
        cost: its truncated error; the answer's is the least.
        odds: how probable it is relative to the answer, 0 to 1.
        rejected: indices that it calls mismatched.
    """

    base_from_object: RigidTransform
    covariance: Array
    cost: float
    odds: float
    rejected: tuple[int, ...]


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

    @property
    def base_from_object(self) -> UncertainPose:
        """The pose with its covariance, as the rest of the cell takes it."""
        return UncertainPose(parent_from_child=self.pose, covariance=self.covariance)

    @property
    def is_ambiguous(self) -> bool:
        """True when another pose is at least a hundredth as probable."""
        return any(a.odds > 0.01 for a in self.alternatives)


def fuse(
    measurements: Sequence[Measurement],
    *,
    prior: UncertainPose | None = None,
    certify: bool = False,
    seed: int = 0,
) -> FusedPose:
    """The pose that the largest agreeing part of the measurements points to.

    Args:
        measurements: any mixture of the nine classes, in any order.
        prior: a pose believed beforehand (say from the four lights) with its covariance; it can be outvoted, and is then
            listed in `rejected` with index -1.
        certify: also bound the error from below by a semidefinite relaxation (needs clarabel).
        seed: of the random subsets; the same input and seed give the same answer.

    Raises:
        InvalidRequest: a measurement makes no sense (`details["index"]`, `details["reason"]`), or there is none.
        Contradiction: no set of measurements agrees by more than chance; `details` names those outside the best set.
    """
    if not len(measurements) and prior is None:
        raise InvalidRequest("no measurement to fuse", hint="give at least one measurement or a prior pose")
    good = checked(measurements)
    repeats = duplicates(good)
    kept = [i for i in range(len(good)) if i not in repeats]
    b = pack([good[i] for i in kept], prior)
    index = np.array([*kept, *([-1] if prior is not None else [])])
    best, others = _minima(b, np.random.default_rng(seed))
    return _judged(b, best, others, index, good, repeats, certify)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Minimum:
    """A minimum of the truncated error: `used` (N,) marks what lies inside its gate."""

    cost: float
    used: Array
    local: LocalSolution


def _minima(b: Batch, rng: np.random.Generator) -> tuple[_Minimum, list[_Minimum]]:
    """The best minimum and the other distinct ones within ALTERNATIVE_COST, best first."""
    n = len(b.cls)
    small = b if n <= MOST_SEARCHED else _part(b, np.sort(rng.choice(n, MOST_SEARCHED, replace=False)))
    poses = _search(small, rng)
    poses += [(c, *p) for c, R, t in poses[:1] for p in _mirrored(small, R, t)]
    found: list[_Minimum] = []
    least = np.inf
    for _, R, t in sorted(poses, key=lambda pose: pose[0]):
        f = np.empty(n)
        cost = search.settle(b, R, t, f, False)
        if cost > least + ALTERNATIVE_COST + 5.0 or any(_same(_pose(R, t), m.local) for m in found):
            continue
        minimum = _finished(b, R, t, f < b.gate)
        least = min(least, minimum.cost)
        if not any(_same(minimum.local.base_from_object, m.local) for m in found):
            found.append(minimum)
    found.sort(key=lambda m: m.cost)
    return found[0], [m for m in found[1:] if m.cost < found[0].cost + ALTERNATIVE_COST]


def _search(b: Batch, rng: np.random.Generator) -> list[tuple[float, Array, Array]]:
    """Settled candidates (cost, R, t), from rounds of subsets until a better pose is improbable."""
    n = len(b.cls)
    done, size = 0, FIRST_ROUND
    found: list[tuple[float, Array, Array]] = []
    inside = 0
    while True:
        draws = rng.random((size, search.DRAWS))
        draws[:, search.SUBSET_MOST :] = rng.normal(size=(size, 4))
        Rs, ts, costs = np.empty((size, 3, 3)), np.empty((size, 3)), np.empty(size)
        search.hypotheses(b, draws, Rs, ts, costs)
        for h in np.argsort(costs)[:SETTLED_PER_ROUND]:
            f = np.empty(n)
            cost = search.settle(b, Rs[h], ts[h], f, True)
            if not found or cost < min(c for c, _, _ in found):
                inside = int(np.sum(f < b.gate))
            found.append((cost, Rs[h], ts[h]))
        done += size
        if done >= min(_enough(n, inside, float(b.dof.mean())), HYPOTHESES):
            return sorted(found, key=lambda c: c[0])
        size = min(2 * size, 512)


def _enough(n: int, inside: int, mean_dof: float) -> float:
    """Subsets after which a clean, converging one has been missed with MISS_PROBABILITY, if `inside` of n are good."""
    picks = min(math.ceil(search.SUBSET_DOF / max(mean_dof, 0.5)), search.SUBSET_MOST, n)
    clean = math.prod(max(inside - k, 0) / (n - k) for k in range(picks))
    return math.log(MISS_PROBABILITY) / math.log1p(-CONVERGES * clean) if clean > 0 else np.inf


def _mirrored(b: Batch, R: Array, t: Array) -> list[tuple[Array, Array]]:
    """The pose turned by half a turn about each principal axis of the features, through their middle."""
    points = b.m[b.cls > 0]
    if not len(points):
        return []
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=True)[2]
    turns = [2.0 * np.outer(a, a) - np.eye(3) for a in axes]
    return [(R @ turn, t + R @ (middle - turn @ middle)) for turn in turns]


def _finished(b: Batch, R: Array, t: Array, used: Array) -> _Minimum:
    """The exact minimum with the set of used measurements brought into agreement with the exact gate."""
    for _ in range(6):
        local = local_solution(b, used.astype(float), R, t, far=False)
        inside = local.values < b.gate
        if np.array_equal(inside, used) or not inside.any():
            break
        used = inside
        R, t = matrix_of(local.base_from_object), np.array(local.base_from_object.translation)
    return _Minimum(cost=float(np.minimum(local.values, b.gate).sum()), used=used, local=local)


def _same(pose: RigidTransform, local: LocalSolution) -> bool:
    """Is `pose` within a few standard deviations of a minimum (free directions do not count)?"""
    other = local.base_from_object
    turn = (pose.rotation * other.rotation.inv()).as_rotvec()
    delta = np.concatenate([pose.translation - other.translation, turn])
    return bool(delta @ np.linalg.solve(local.covariance, delta) < SAME_SIGMAS**2 + 1e-12)


def _pose(R: Array, t: Array) -> RigidTransform:
    return RigidTransform.from_components(t, Rotation.from_matrix(R))


def _part(b: Batch, chosen: Array) -> Batch:
    rows = {name: getattr(b, name)[chosen] for name in Batch._fields if not name.startswith("prior")}
    return b._replace(**rows)


def _judged(
    b: Batch,
    best: _Minimum,
    others: list[_Minimum],
    index: Array,
    given: Sequence[Measurement],
    repeats: dict[int, int],
    certify: bool,
) -> FusedPose:
    values = np.zeros(len(given))
    own = index >= 0
    values[index[own]] = best.local.values[own]
    for repeat, first in repeats.items():
        values[repeat] = values[first]
    rejected = _rejected(b, best, index, given) + [
        Rejected(index=i, label=given[i].label, value=values[i], limit=0.0, reason=f"duplicate of measurement {first}")
        for i, first in repeats.items()
    ]
    evidence = log_evidence(b, best.used, best.local)
    mismatched = [r for r in rejected if r.reason == "mismatch"]
    if mismatched and evidence < EVIDENCE_NEEDED:
        raise Contradiction.among(int(best.used.sum()), len(b.cls), [(r.index, r.label, r.value) for r in mismatched])
    local = best.local
    return FusedPose(
        pose=local.base_from_object,
        covariance=local.covariance,
        chi_square=local.chi_square,
        dof=local.dof,
        values=values,
        rejected=tuple(sorted(rejected, key=lambda r: r.index)),
        unobservable=local.unobservable,
        alternatives=() if local.unobservable else _alternatives(best, others, index),
        evidence=evidence,
        certificate=certificate(b, best.used, local) if certify else None,
    )


def _rejected(b: Batch, best: _Minimum, index: Array, given: Sequence[Measurement]) -> list[Rejected]:
    return [
        Rejected(
            index=int(index[k]),
            label=given[index[k]].label if index[k] >= 0 else "prior pose",
            value=float(best.local.values[k]),
            limit=float(b.gate[k]),
            reason="mismatch",
        )
        for k in np.flatnonzero(~best.used)
    ]


def _alternatives(best: _Minimum, others: Sequence[_Minimum], index: Array) -> tuple[Alternative, ...]:
    made = [
        Alternative(
            base_from_object=m.local.base_from_object,
            covariance=m.local.covariance,
            cost=m.cost,
            odds=_odds(m, best),
            rejected=tuple(int(i) for i in index[~m.used]),
        )
        for m in others
        if not m.local.unobservable
    ]
    return tuple(sorted(made, key=lambda a: -a.odds))


def _odds(m: _Minimum, best: _Minimum) -> float:
    """exp(-delta/2) sqrt(det cov / det cov_best): share of the posterior around each (Laplace)."""
    size = np.linalg.slogdet(m.local.covariance)[1] - np.linalg.slogdet(best.local.covariance)[1]
    return float(np.exp(min(0.5 * (best.cost - m.cost) + 0.5 * size, 0.0)))
