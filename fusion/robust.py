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
from scipy.spatial.transform import RigidTransform

from fusion import search
from fusion.batch import Batch, duplicates, pack
from fusion.certify import Certificate, certificate
from fusion.errors import Contradiction
from fusion.evidence import log_evidence
from fusion.measurement import Measurement
from fusion.observability import FreeDirection
from fusion.rows import values
from fusion.solve import LocalSolution, local_solution
from hal.errors import InvalidRequest
from hal.geometry import Array, UncertainPose

MOST_SEARCHED = 96  # measurements that the search looks at; the finish uses all
HYPOTHESES = 6000  # at most
FIRST_ROUND = 32
MISS_PROBABILITY = 1e-4  # of never drawing a clean subset that also converges
CONVERGES = 0.25  # share of clean subsets that reach their pose from a random rotation (measured 0.27)
SETTLED_PER_ROUND = 8
LARGEST_ROUND = 512
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
    repeats = duplicates(measurements)
    index = np.array([*range(len(measurements)), *([-1] if prior is not None else [])])
    b = pack(measurements, prior)
    if repeats:
        first = np.array([i not in repeats for i in index])
        index, b = index[first], b.part(first)
    best, others = _minima(b, np.random.default_rng(seed))
    return _judged(b, best, others, index, measurements, repeats, certify)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Minimum:
    """A minimum of the truncated error: `used` (N,) marks what lies inside its gate."""

    cost: float
    used: Array
    local: LocalSolution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Candidates:
    """Settled poses, cheapest first: rotations (K, 3, 3), translations (K, 3), truncated errors (K,)."""

    R: Array
    t: Array
    cost: Array


def _minima(b: Batch, rng: np.random.Generator) -> tuple[_Minimum, list[_Minimum]]:
    """The best minimum and the other distinct ones within ALTERNATIVE_COST, best first."""
    n = len(b.cls)
    small = b if n <= MOST_SEARCHED else b.part(np.sort(rng.choice(n, MOST_SEARCHED, replace=False)))
    poses = _search(small, rng)
    found: list[_Minimum] = []
    f, least = np.empty(n), np.inf
    for k in range(len(poses.cost)):
        R, t = poses.R[k], poses.t[k]
        if any(_same(R, t, m.local) for m in found):
            continue
        if small is not b:
            search.settle(b, R, t, f, False)
        minimum = _finished(b, R, t)
        if minimum.cost < least + ALTERNATIVE_COST and not any(
            _same(minimum.local.rotation, minimum.local.translation_m, m.local) for m in found
        ):
            found.append(minimum)
            least = min(least, minimum.cost)
    found.sort(key=lambda m: m.cost)
    return found[0], [m for m in found[1:] if m.cost < found[0].cost + ALTERNATIVE_COST]


def _search(b: Batch, rng: np.random.Generator) -> _Candidates:
    """Settled candidates from rounds of subsets, until a better pose is improbable; only those near the least cost."""
    n, done, size = len(b.cls), 0, FIRST_ROUND
    rounds: list[tuple[Array, Array, Array]] = []
    least, agreeing = np.inf, 0
    while True:
        draws = rng.random((size, search.DRAWS))
        draws[:, search.SUBSET_MOST :] = rng.normal(size=(size, search.DRAWS - search.SUBSET_MOST))
        R, t, cost, inside = np.empty((size, 3, 3)), np.empty((size, 3)), np.empty(size), np.empty(size, np.int64)
        kept = search.candidates(b, draws, SETTLED_PER_ROUND, R, t, cost, inside)
        rounds.append((R[:kept], t[:kept], cost[:kept]))
        if kept and cost[0] < least:
            least, agreeing = float(cost[0]), int(inside[0])
        done += size
        wanted = min(_enough(b, agreeing), HYPOTHESES)
        if done >= wanted:
            break
        size = int(min(max(wanted - done, FIRST_ROUND), LARGEST_ROUND, 3 * size))
    R, t, cost = (np.concatenate(part) for part in zip(*rounds, strict=True))
    if not len(cost):
        raise Contradiction.among(0, n, [])
    return _nearby(b, _Candidates(R=R, t=t, cost=cost))


def _nearby(b: Batch, found: _Candidates) -> _Candidates:
    """Candidates near the least cost, with the mirror images of the best one."""
    best = int(np.argmin(found.cost))
    R, t, cost = _mirrored(b, found.R[best], found.t[best])
    R, t, cost = np.concatenate([found.R, R]), np.concatenate([found.t, t]), np.concatenate([found.cost, cost])
    order = np.argsort(cost, kind="stable")
    order = order[cost[order] < cost[order[0]] + ALTERNATIVE_COST + 5.0]
    return _Candidates(R=R[order], t=t[order], cost=cost[order])


def _enough(b: Batch, agreeing: int) -> float:
    """Subsets after which a clean, converging one has been missed with MISS_PROBABILITY, if `agreeing` dof are good."""
    total = int(b.dof.sum())
    typical = float(b.dof @ b.dof) / max(total, 1)  # of an entry picked in proportion to its dof
    picks = min(math.ceil(search.SUBSET_DOF / max(typical, 1.0)), search.SUBSET_MOST, len(b.dof))
    clean = math.prod(max(agreeing - k * typical, 0.0) / max(total - k * typical, 1.0) for k in range(picks))
    return math.log(MISS_PROBABILITY) / math.log1p(-CONVERGES * min(clean, 1.0)) if clean > 0 else np.inf


def _mirrored(b: Batch, R: Array, t: Array) -> tuple[Array, Array, Array]:
    """Settled poses from half a turn about each principal axis of the features, through their middle; and their costs."""
    points = b.m[b.cls > 0]
    if not len(points):
        return np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0)
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=True)[2]
    turns = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    Rs, ts = R @ turns, t + (middle - turns @ middle) @ R.T
    f = np.empty(len(b.cls))
    costs = np.array([search.settle(b, Rs[k], ts[k], f, True) for k in range(3)])
    return Rs, ts, costs


def _finished(b: Batch, R: Array, t: Array) -> _Minimum:
    """The exact minimum near R, t with the set of used measurements brought into agreement with the exact gate."""
    f = np.empty(len(b.cls))
    values(b, R, t, False, f)
    used = f < b.gate
    for _ in range(6):
        local = local_solution(b, used.astype(float), R, t, far=False)
        inside = local.values < b.gate
        if np.array_equal(inside, used) or not inside.any():
            break
        used, R, t = inside, local.rotation, local.translation_m
    return _Minimum(cost=float(np.minimum(local.values, b.gate).sum()), used=used, local=local)


def _same(R: Array, t: Array, local: LocalSolution) -> bool:
    """Is R, t within a few standard deviations of a minimum? (Free directions do not count.)"""
    W = R @ local.rotation.T
    half = 0.5 * np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])
    cosine, sine = 0.5 * (np.trace(W) - 1.0), math.sqrt(half @ half)
    if cosine < 0.0 and not local.unobservable:
        return False
    delta = np.concatenate([t - local.translation_m, half * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)])
    return bool(delta @ local.information @ delta < SAME_SIGMAS**2)


def _judged(
    b: Batch,
    best: _Minimum,
    others: list[_Minimum],
    index: Array,
    given: Sequence[Measurement],
    repeats: dict[int, int],
    certify: bool,
) -> FusedPose:
    f = np.zeros(len(given))
    own = index >= 0
    f[index[own]] = best.local.values[own]
    for repeat, first in repeats.items():
        f[repeat] = f[first]
    rejected = _rejected(b, best, index, given) + [
        Rejected(index=i, label=given[i].label, value=float(f[i]), limit=0.0, reason=f"duplicate of measurement {first}")
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
        values=f,
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


def _odds(m: _Minimum, best: _Minimum) -> float:
    """exp(-delta/2) sqrt(det cov / det cov_best): share of the posterior around each (Laplace)."""
    size = np.linalg.slogdet(m.local.covariance)[1] - np.linalg.slogdet(best.local.covariance)[1]
    return float(np.exp(min(0.5 * (best.cost - m.cost) + 0.5 * size, 0.0)))


def used_entries(measurements: Sequence[Measurement], answer: FusedPose) -> tuple[Batch, Array, LocalSolution]:
    """An answer's measurements packed, which of them it used (N,), and the local solution there: for a certificate.

    Raises:
        InvalidRequest: a measurement makes no sense.
    """
    b = pack(measurements)
    used = np.ones(len(measurements), bool)
    used[[r.index for r in answer.rejected if r.index >= 0]] = False
    R, t = answer.pose.rotation.as_matrix(), np.array(answer.pose.translation)
    return b, used, local_solution(b, used.astype(float), R, t, far=False)
