"""The best set of measurements, proven by branch and bound over the inlier sets.

The truncated error sum min(E_i, gate_i) of N measurements is the least, over all 2^N sets I, of

    min over poses of sum_{i in I} E_i  +  sum_{i not in I} gate_i.

A node of the tree has decided some measurements: I are inliers, O outliers. Whatever is decided for the rest, the error
is at least min sum_I E_i + sum_O gate_i, and `fusion.certify` gives a lower bound of the first term. Nodes whose
bound exceeds the best error known are cut off; when none is left, that error is proven to be the least. E_i is the
local pose function with its covariance frozen at the given solution, so the proof holds for that quadratic error. This
changes little for classes 1, 2, 3, 5 and 9, whose residuals have a constant covariance up to the object's rotation; for
4, 6, 7 and 8 it is first order.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from fusion.batch import Batch
from fusion.certify.dual import minimiser
from fusion.certify.proof import monomials, quadratic_forms
from fusion.certify.relaxation import nearest_pose, relaxed
from fusion.solve.local import LocalSolution, middle_and_size
from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import transform

MOST = 16  # measurements; the tree has up to 2^N leaves
RELATIVE_GAP = 1e-4  # two errors closer than this share are the same
SOLVER_SLACK = 1e-5  # share of the largest error by which the solver's bound may be too high
RESCUES = 20  # alternations between a pose and the set inside its gates
IGNORED_DOF = 6  # fewer constraints than this fit some pose exactly, so their bound is zero without computing it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProvenSet:
    """Result of branch and bound.

    Attributes:
        believed: indices of the inliers of the best set; -1 for a prior pose.
        cost: its truncated error, covariances frozen at the given solution.
        lower_bound: no pose has a smaller truncated error; equal to `cost` (to 1e-4) when proven.
        gap: cost - lower_bound, which is left at the deadline.
        proven: whether the tree was searched to its end.
        agrees: whether the best set is the one that the given solution used.
        nodes: number of sets examined.
        base_from_object: the pose of the best set.
    """

    believed: tuple[int, ...]
    cost: float
    lower_bound: float
    gap: float
    proven: bool
    agrees: bool
    nodes: int
    base_from_object: RigidTransform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Node:
    """A partial decision: `state` (N,) is 1 inlier, 0 outlier, -1 undecided.

    `bound` is a lower bound of the truncated error; `R`, `t` is a pose that fits the inliers.
    """

    state: NDArray[np.int64]
    bound: float
    R: Array
    t: Array


def best_set(
    b: Batch,
    used: NDArray[np.bool_],
    local: LocalSolution,
    index: NDArray[np.int64],
    *,
    deadline_s: float,
    clock: Callable[[], float] = time.monotonic,
) -> ProvenSet:
    """Return the set of measurements with the least truncated error, proven or with the gap left at the deadline.

    Args:
        b: at most 16 packed measurements (a prior pose counts as one).
        used: (N,) inliers of the given solution `local`.
        index: (N,) the caller's index of each.
        deadline_s: how long to search; the best set so far is returned then.
        clock: seconds, for tests.

    Raises:
        InvalidRequest: more than 16 measurements.
        Unsupported: a node needs the relaxation, and clarabel is not installed.
    """
    if len(b.cls) > MOST:
        raise too_many(len(b.cls))
    lever, size = middle_and_size(b, used, local.rotation)
    about, middle = local.rotation.T @ lever, local.translation_m + lever
    forms = quadratic_forms(b, local.rotation, local.translation_m, about, middle, size)
    start_t = (local.translation_m + local.rotation @ about - middle) / size
    tree = _Tree(forms, b.gate, b.dof, local.rotation, start_t)
    ends_s = clock() + deadline_s
    while tree.open and clock() < ends_s:
        tree.step()
    bound = min([tree.cost, *(node.bound for _, _, node in tree.open)])
    best = errors(forms, tree.R, tree.t) < b.gate
    return ProvenSet(
        believed=tuple(int(i) for i in index[best]),
        cost=tree.cost,
        lower_bound=bound,
        gap=tree.cost - bound,
        proven=not tree.open,
        agrees=bool(np.array_equal(best, used)),
        nodes=tree.nodes,
        base_from_object=transform(tree.R, size * tree.t + middle - tree.R @ about),
    )


def too_many(count: int) -> InvalidRequest:
    """Return the error for a set that is too large for branch and bound."""
    what = f"branch and bound takes at most {MOST} measurements, not {count}"
    return InvalidRequest(what, hint="leave out `prove_set_within_s`, or those that are beyond doubt")


def errors(forms: Array, R: Array, t: Array) -> Array:
    """Return (N,) E_i = z^T Q_i z at a pose, in the units of the forms (N, 16, 16)."""
    z = monomials(R, t)
    return np.asarray(forms @ z @ z)


class _Tree:
    """Open nodes sorted by bound, and the best truncated error so far with its pose."""

    def __init__(self, forms: Array, gate: Array, dof: NDArray[np.int64], R: Array, t: Array) -> None:
        self.forms, self.gate, self.dof = forms, gate, dof
        self.cost, self.R, self.t, self.nodes = math.inf, R, t, 0
        self._improve(R, t)
        root = _Node(state=np.full(len(gate), -1), bound=0.0, R=R, t=t)
        self.open: list[tuple[float, int, _Node]] = [(0.0, 0, root)]

    def step(self) -> None:
        """Take the node with the least bound and decide one more measurement."""
        _, _, node = heapq.heappop(self.open)
        undecided = np.flatnonzero(node.state < 0)
        if not len(undecided) or self._is_hopeless(node.bound):
            return
        f = errors(self.forms, node.R, node.t)
        # Decide first the measurement that fits worst here or, near the start, has the most constraints.
        k = int(undecided[np.argmax(np.minimum(f, self.gate)[undecided] + 1e-3 * self.dof[undecided])])
        for believe in (1, 0):
            state = node.state.copy()
            state[k] = believe
            self._add(state, node)

    def _add(self, state: NDArray[np.int64], parent: _Node) -> None:
        """Bound a node; keep it if it may hold a better set than the best known."""
        self.nodes += 1
        left_out = float(self.gate[state == 0].sum())
        believed = state == 1
        R, t, inner = parent.R, parent.t, parent.bound - float(self.gate[parent.state == 0].sum())
        if believed.sum() > (parent.state == 1).sum() and self.dof[believed].sum() > IGNORED_DOF:
            R, t, inner = self._fitted(believed, parent)
            self._improve(R, t)
        bound = max(parent.bound, inner + left_out)
        if not self._is_hopeless(bound):
            heapq.heappush(self.open, (bound, self.nodes, _Node(state=state, bound=bound, R=R, t=t)))

    def _fitted(self, believed: NDArray[np.bool_], parent: _Node) -> tuple[Array, Array, float]:
        """Return a pose that fits the inliers, and a lower bound of their error over all poses."""
        Q = self.forms[believed].sum(axis=0)
        found = minimiser(Q, parent.R, parent.t)
        if found.proven:
            return found.rotation, found.translation, found.value
        Z, bound = relaxed(Q)
        again = minimiser(Q, *nearest_pose(np.linalg.eigh(Z)[1][:, -1]))
        better = again if again.value < found.value else found
        return better.rotation, better.translation, max(bound - SOLVER_SLACK * (1.0 + abs(bound)), 0.0)

    def _improve(self, R: Array, t: Array) -> None:
        """Descend on the truncated error from a pose: fit the inliers of the gates until their set is stable."""
        inside = None
        for _ in range(RESCUES):
            f = errors(self.forms, R, t)
            cost, now = float(np.minimum(f, self.gate).sum()), f < self.gate
            if cost < self.cost:
                self.cost, self.R, self.t = cost, R, t
            if not now.any() or (inside is not None and np.array_equal(now, inside)):
                return
            inside = now
            found = minimiser(self.forms[inside].sum(axis=0), R, t, prove=False)
            R, t = found.rotation, found.translation

    def _is_hopeless(self, bound: float) -> bool:
        return bound > self.cost - RELATIVE_GAP * (1.0 + self.cost)
