"""RRT-Connect in joint space.

OMPL is not used, because it has one random seed per process instead of one per plan, and calls Python for every state.
Here a check takes microseconds, and the whole search consists of a few compiled calls.

Source: Kuffner and LaValle, ICRA 2000; shortcuts after Geraerts and Overmars, IJRR 26(8), 2007.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.arrays import Array

Free = Callable[[Array, Array], float]
"""`free(start, end)`: fraction of the straight segment that is free."""


WORTH = 0.99  # a shortcut that saves less is not checked


class _Tree:
    """Configurations and their parents, in growing arrays."""

    def __init__(self, root: Array, weights: Array) -> None:
        self._q = np.empty((256, len(root)))
        self._q[0] = root
        self._parent = [-1]
        self._weights = weights

    def nearest(self, q: Array) -> int:
        gaps = (self._q[: len(self._parent)] - q) * self._weights
        return int(np.argmin(np.einsum("ij,ij->i", gaps, gaps)))

    def add(self, q: Array, parent: int) -> int:
        count = len(self._parent)
        if count == len(self._q):
            self._q = np.concatenate([self._q, np.empty_like(self._q)])
        self._q[count] = q
        self._parent.append(parent)
        return count

    def configuration(self, index: int) -> Array:
        return np.array(self._q[index])

    def branch(self, index: int) -> list[Array]:
        out = []
        while index >= 0:
            out.append(self.configuration(index))
            index = self._parent[index]
        return out[::-1]


def connect(
    start: Array,
    goal: Array,
    *,
    free: Free,
    lower: Array,
    upper: Array,
    seed: int,
    step_rad: float = 0.5,
    max_nodes: int = 4000,
) -> Array | None:
    """Return a path (N, n) of free straight segments from start to goal, or None when the search ran out of nodes."""
    rng = np.random.default_rng(seed)
    weights = np.linspace(1.0, 0.4, len(start))  # the first joints sweep the largest volumes
    trees = [_Tree(start, weights), _Tree(goal, weights)]
    active = 0
    for _ in range(max_nodes):
        target = rng.uniform(lower, upper)
        new = _extend(trees[active], target, free, step_rad)
        if new is not None:
            met = _connect(trees[1 - active], trees[active].configuration(new), free, step_rad)
            if met is not None:
                first, second = (new, met) if active == 0 else (met, new)
                return np.array(trees[0].branch(first) + trees[1].branch(second)[::-1][1:])
        active = 1 - active
    return None


def _extend(tree: _Tree, target: Array, free: Free, step_rad: float) -> int | None:
    """Make one step towards the target, cut at the first obstacle; None when it cannot move."""
    near = tree.nearest(target)
    q = tree.configuration(near)
    ahead = target - q
    length = float(np.max(np.abs(ahead)))
    if length < 1e-9:
        return near
    end = q + ahead * min(1.0, step_rad / length)
    fraction = free(q, end)
    if fraction * min(step_rad, length) < 0.02:
        return None
    return tree.add(q + fraction * (end - q), near)


def _connect(tree: _Tree, target: Array, free: Free, step_rad: float) -> int | None:
    """Step towards the target until it is reached (returns its index) or an obstacle stops the steps (None)."""
    while True:
        new = _extend(tree, target, free, step_rad)
        if new is None:
            return None
        reached = tree.configuration(new)
        if np.max(np.abs(reached - target)) < 1e-9:
            return new
        if free(reached, reached + 1e-3 * (target - reached)) < 1.0:
            return None


def shortcut(path: Array, *, free: Free, seed: int, rounds: int = 80) -> Array:
    """Return the path with free straight cuts between random points of it, and without needless corners."""
    rng = np.random.default_rng(seed)
    points = [q for q in path]
    for _ in range(rounds):
        if len(points) < 3:
            break
        i, j = sorted(rng.integers(0, len(points) - 1, 2))
        if i == j:
            continue
        a = points[i] + rng.random() * (points[i + 1] - points[i])
        b = points[j] + rng.random() * (points[j + 1] - points[j])
        round_about = _length([a, *points[i + 1 : j + 1], b])
        if np.linalg.norm(b - a) < WORTH * round_about and free(a, b) == 1.0:
            points = [*points[: i + 1], a, b, *points[j + 1 :]]
    return _without_repeats(np.array(points))


def _length(points: list[Array]) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _without_repeats(path: Array) -> Array:
    moved = np.concatenate([[True], np.max(np.abs(np.diff(path, axis=0)), axis=1) > 1e-6])
    moved[-1] = True
    kept = path[moved]
    if len(kept) > 2 and np.max(np.abs(kept[-1] - kept[-2])) <= 1e-6:
        kept = np.delete(kept, -2, axis=0)
    return np.asarray(kept)
