"""The minima of the truncated error sum min(f_i, gate_i): found from small subsets, finished on the exact functions.

The gate passes 99.9 % of good measurements (notes/fusion.md, "Robust").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch
from fusion.distance.rows import values
from fusion.errors import Contradiction
from fusion.robust import search
from fusion.solve.local import LocalSolution, local_solution
from hal.geometry import Array

Flags = NDArray[np.bool_]
MOST_SEARCHED = 96  # measurements that the search looks at; the finish uses all
HYPOTHESES = 6000  # at most
FIRST_ROUND = 32
MISS_PROBABILITY = 1e-4  # of never drawing a clean subset that also converges
CONVERGES = 0.25  # share of clean subsets that reach their pose from a random rotation (measured 0.27)
SETTLED_PER_ROUND = 8
LARGEST_ROUND = 512
READMITTED = 3  # cheapest candidates whose rejected measurements are tried again
ALTERNATIVE_COST = 18.0  # a minimum this much worse has odds below 1e-4
SAME_SIGMAS = 6.0  # minima closer than this are one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minimum:
    """A minimum of the truncated error: `used` (N,) marks what lies inside its gate."""

    cost: float
    used: Flags
    local: LocalSolution

    def near(self, other: Minimum) -> bool:
        """Is `other` another pose, and good enough to be mentioned?"""
        apart = not _same(other.local.rotation, other.local.translation_m, self.local)
        return apart and other.cost < self.cost + ALTERNATIVE_COST


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Settled poses, cheapest first: rotations (K, 3, 3), translations (K, 3), truncated errors (K,)."""

    R: Array
    t: Array
    cost: Array


def minima(b: Batch, rng: np.random.Generator) -> tuple[Minimum, list[Minimum]]:
    """The best minimum and the other distinct ones within ALTERNATIVE_COST, best first."""
    n = len(b.cls)
    small = b if n <= MOST_SEARCHED else b.part(np.sort(rng.choice(n, MOST_SEARCHED, replace=False)))
    poses = _search(small, rng)
    found: list[Minimum] = []
    f, least = np.empty(n), np.inf
    for k in range(len(poses.cost)):
        R, t = poses.R[k], poses.t[k]
        if k < READMITTED:
            search.readmit(small, R, t, poses.cost[k])
        # A pose from part of the measurements is only as exact as those are.
        if any(_same(R, t, m.local, share=len(small.cls) / n) for m in found):
            continue
        if small is not b:
            search.settle(b, R, t, f, False)
        minimum = finished(b, R, t)
        if minimum.cost < least + ALTERNATIVE_COST and not any(
            _same(minimum.local.rotation, minimum.local.translation_m, m.local) for m in found
        ):
            found.append(minimum)
            least = min(least, minimum.cost)
    found.sort(key=lambda m: m.cost)
    return found[0], [m for m in found[1:] if m.cost < found[0].cost + ALTERNATIVE_COST]


def _search(b: Batch, rng: np.random.Generator) -> Candidates:
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
    return _nearby(b, Candidates(R=R, t=t, cost=cost))


def _nearby(b: Batch, found: Candidates) -> Candidates:
    """Candidates near the least cost, with the mirror images of the best one."""
    best = int(np.argmin(found.cost))
    R, t, cost = _mirrored(b, found.R[best], found.t[best])
    R, t, cost = np.concatenate([found.R, R]), np.concatenate([found.t, t]), np.concatenate([found.cost, cost])
    order = np.argsort(cost, kind="stable")
    order = order[cost[order] < cost[order[0]] + ALTERNATIVE_COST + 5.0]
    return Candidates(R=R[order], t=t[order], cost=cost[order])


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


def finished(b: Batch, R: Array, t: Array) -> Minimum:
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
    return Minimum(cost=float(np.minimum(local.values, b.gate).sum()), used=used, local=local)


def _same(R: Array, t: Array, local: LocalSolution, *, share: float = 1.0) -> bool:
    """Is R, t within a few standard deviations of a minimum, when it rests on a `share` of its information?"""
    W = R @ local.rotation.T
    half = 0.5 * np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])
    cosine, sine = 0.5 * (np.trace(W) - 1.0), math.sqrt(half @ half)
    if cosine < 0.0 and not local.unobservable:
        return False
    delta = np.concatenate([t - local.translation_m, half * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)])
    return bool(share * (delta @ local.information @ delta) < SAME_SIGMAS**2)
