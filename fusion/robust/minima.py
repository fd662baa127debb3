"""The minima of the truncated error sum min(f_i, gate_i), found from small subsets and refined on the exact functions.

The gate passes 99.9 % of good measurements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch
from fusion.distance.rows import values
from fusion.robust import search
from fusion.solve.local import LocalSolution, local_solution
from fusion.solve.placement import place
from hal.arrays import Array

Flags = NDArray[np.bool_]
MOST_SEARCHED = 96  # largest number of measurements in the search; the final solution uses all
HYPOTHESES = 6000  # largest number of hypotheses
FIRST_ROUND = 32
MISS_PROBABILITY = 1e-4  # probability of drawing no clean subset that also converges
CONVERGES = 0.25  # share of clean subsets that converge from a random rotation (measured 0.27)
SETTLED_PER_ROUND = 8
LARGEST_ROUND = 512
SCARCE_DOF = 8  # with at most this many constraints, several poses may fit that are not related by a symmetry
EVERYWHERE = 256  # number of hypotheses from which all such poses are searched
MOST_POSES = 32  # largest number of them to settle; poses closer than ALIKE_RAD and ALIKE_M count as one
ALIKE_RAD, ALIKE_M = 0.02, 0.002
AIMED = (2, 3, 5, 6, 8, 9)  # classes whose object feature has a direction
MOST_MIRRORED = 16  # number of minima whose mirror images are tried
READMITTED = 3  # number of cheapest candidates whose rejected measurements are tried again
ALTERNATIVE_COST = 18.0  # a minimum that is worse by more than this has odds below 1e-4
SAME_SIGMAS = 6.0  # minima closer than this are one
# Minima with a free motion are the same within this angle, because their information is only local.
FREE_COSINE = math.cos(0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseMinimum:
    """A minimum of the truncated error; `used` (N,) marks the measurements inside their gates."""

    cost: float
    used: Flags
    local: LocalSolution

    def near(self, other: PoseMinimum) -> bool:
        """Return whether `other` is another pose and good enough to be reported."""
        apart = not _same(other.local.rotation, other.local.translation_m, self.local)
        return apart and other.cost < self.cost + ALTERNATIVE_COST


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Settled poses, cheapest first: rotations (K, 3, 3), translations (K, 3), truncated errors (K,)."""

    R: Array
    t: Array
    cost: Array


def minima(b: Batch, rng: np.random.Generator) -> tuple[PoseMinimum, list[PoseMinimum]]:
    """Return the best minimum and the other distinct ones within ALTERNATIVE_COST, best first."""
    n = len(b.cls)
    small = b if n <= MOST_SEARCHED else b.part(np.sort(rng.choice(n, MOST_SEARCHED, replace=False)))
    found: list[PoseMinimum] = []
    poses = _search(small, rng)
    for k in range(min(READMITTED, len(poses.cost))):
        search.readmit(small, poses.R[k], poses.t[k], poses.cost[k])
    f, least, waiting = np.empty(n), np.inf, [poses]
    while waiting:
        poses = waiting.pop(0)
        for R, t in zip(poses.R, poses.t, strict=True):
            # A pose from a part of the measurements is only as exact as that part.
            if any(_same(R, t, m.local, share=len(small.cls) / n) for m in found):
                continue
            if small is not b:
                search.settle(b, R, t, f, False)
            minimum = finished(b, R, t)
            local = minimum.local
            if minimum.cost < least + ALTERNATIVE_COST and not any(
                _same(local.rotation, local.translation_m, m.local) for m in found
            ):
                found.append(minimum)
                least = min(least, minimum.cost)
                if not local.unobservable and len(found) <= MOST_MIRRORED:
                    waiting.append(_nearby(_mirrored(small, local.rotation, local.translation_m), least))
    found.sort(key=lambda m: m.cost)
    return found[0], [m for m in found[1:] if m.cost < found[0].cost + ALTERNATIVE_COST]


def _search(b: Batch, rng: np.random.Generator) -> Candidates:
    """Return settled candidates near the least cost, from rounds of subsets until a better pose is improbable."""
    n, done, size = len(b.cls), 0, FIRST_ROUND
    rounds: list[tuple[Array, Array, Array]] = []
    least, agreeing = np.inf, 0
    while True:
        draws = _draws(rng, size)
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
    if not len(cost):  # no subset fits any pose; the result for this one shows how badly each measurement fits
        R, t = np.eye(3)[np.newaxis], np.zeros((1, 3))
        place(b, np.ones(n), R[0], t[0])
        cost = np.array([search.settle(b, R[0], t[0], np.empty(n), True)])
    if 6 <= agreeing <= SCARCE_DOF:
        more = _everywhere(b, rng)
        R, t, cost = np.concatenate([R, more.R]), np.concatenate([t, more.t]), np.concatenate([cost, more.cost])
    return _nearby(Candidates(R=R, t=t, cost=cost), float(cost.min()))


def _nearby(found: Candidates, least: float) -> Candidates:
    """Return the candidates that may become minima worth reporting, cheapest first."""
    order = np.argsort(found.cost, kind="stable")
    order = order[found.cost[order] < least + ALTERNATIVE_COST + 5.0]
    return Candidates(R=found.R[order], t=found.t[order], cost=found.cost[order])


def _enough(b: Batch, agreeing: int) -> float:
    """Return the number of subsets after which a clean, converging one is missed with only MISS_PROBABILITY.

    `agreeing`: degrees of freedom of the inliers.
    """
    total = int(b.dof.sum())
    typical = float(b.dof @ b.dof) / max(total, 1)  # of an entry picked in proportion to its dof
    picks = min(math.ceil(search.SUBSET_DOF / max(typical, 1.0)), search.SUBSET_MOST, len(b.dof))
    clean = math.prod(max(agreeing - k * typical, 0.0) / max(total - k * typical, 1.0) for k in range(picks))
    return math.log(MISS_PROBABILITY) / math.log1p(-CONVERGES * min(clean, 1.0)) if clean > 0 else np.inf


def _draws(rng: np.random.Generator, count: int) -> Array:
    """Return the random numbers of `count` hypotheses, (count, DRAWS): uniform picks, then normal quaternions."""
    made = rng.random((count, search.DRAWS))
    made[:, search.SUBSET_MOST :] = rng.normal(size=(count, search.DRAWS - search.SUBSET_MOST))
    return made


def _everywhere(b: Batch, rng: np.random.Generator) -> Candidates:
    """Return settled poses from many hypotheses, one per group of similar ones; three rays, say, fit up to four.

    `_search` stops at a pose that cannot be improved and may miss other poses that fit equally well.
    """
    draws = _draws(rng, EVERYWHERE)
    R, t, cost = np.empty((EVERYWHERE, 3, 3)), np.empty((EVERYWHERE, 3)), np.empty(EVERYWHERE)
    search.hypotheses(b, draws, R, t, cost)
    kept: list[int] = []
    for h in np.argsort(cost)[: int(np.sum(cost < cost.min() + search.OTHER_COST))]:
        cosines = 0.5 * (np.einsum("kij,ij->k", R[kept], R[h]) - 1.0)
        alike = (cosines > math.cos(ALIKE_RAD)) & (np.linalg.norm(t[kept] - t[h], axis=1) < ALIKE_M)
        if not alike.any():
            kept.append(int(h))
        if len(kept) == MOST_POSES:
            break
    R, t, f = R[kept], t[kept], np.empty(len(b.cls))
    return Candidates(R=R, t=t, cost=np.array([search.settle(b, R[k], t[k], f, False) for k in range(len(kept))]))


def _mirrored(b: Batch, R: Array, t: Array) -> Candidates:
    """Return settled poses after half a turn about each principal axis of the features' points and directions.

    Each gets the translation that best fits the inliers of the pose R, t.
    """
    own, aimed = b.cls > 0, np.isin(b.cls, AIMED)
    if not own.any():
        return Candidates(R=np.empty((0, 3, 3)), t=np.empty((0, 3)), cost=np.empty(0))
    axes = np.linalg.svd(b.m[own] - b.m[own].mean(axis=0), full_matrices=True)[2]
    if aimed.any():
        axes = np.concatenate([axes, np.linalg.svd(b.w[aimed], full_matrices=True)[2]])
    Rs = R @ (2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3))
    ts, costs, f = np.tile(t, (len(Rs), 1)), np.empty(len(Rs)), np.empty(len(b.cls))
    values(b, R, t, False, f)
    use = (f < b.gate).astype(float)
    for k in range(len(Rs)):
        place(b, use, Rs[k], ts[k])
        costs[k] = search.settle(b, Rs[k], ts[k], f, True)
    return Candidates(R=Rs, t=ts, cost=costs)


def finished(b: Batch, R: Array, t: Array) -> PoseMinimum:
    """Return the exact minimum near R, t, with the set of used measurements made consistent with the exact gate."""
    f = np.empty(len(b.cls))
    values(b, R, t, False, f)
    used = f < b.gate
    for _ in range(6):
        local = local_solution(b, used.astype(float), R, t, far=False)
        inside = local.values < b.gate
        if np.array_equal(inside, used) or not inside.any():
            break
        used, R, t = inside, local.rotation, local.translation_m
    return PoseMinimum(cost=float(np.minimum(local.values, b.gate).sum()), used=used, local=local)


def _same(R: Array, t: Array, local: LocalSolution, *, share: float = 1.0) -> bool:
    """Return whether R, t is within a few sigmas of a minimum, if it rests on a `share` of its information."""
    W = R @ local.rotation.T
    half = 0.5 * np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])
    cosine, sine = 0.5 * (np.trace(W) - 1.0), math.sqrt(half @ half)
    if cosine < (FREE_COSINE if local.unobservable else 0.0):
        return False
    delta = np.concatenate([t - local.translation_m, half * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)])
    return bool(share * (delta @ local.information @ delta) < SAME_SIGMAS**2)
