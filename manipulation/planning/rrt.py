"""RRT-Connect in joint space, compiled as a whole.

OMPL is not used, because it has one random seed per process instead of one per plan, and calls Python for every state.

Source: Kuffner and LaValle, ICRA 2000; shortcuts after Geraerts and Overmars, IJRR 26(8), 2007.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.arrays import Array, Mask
from hal.jit import compiled, inlined
from manipulation.planning.clearance import Index, first_hit
from manipulation.planning.collision import CollisionModel

Free = Callable[[Array, Array], float]
"""`free(start, end)`: fraction of the straight segment that is free."""

STEP_RAD = 0.5  # of the trees
BLOCKED, CUT, FREE, REACHED = range(4)  # how far a step came: no way, up to an obstacle, a whole step, the target
ROOM = 256  # configurations of a tree at first
LEAST_STEP_RAD = 0.02  # a shorter free part of a step is not added
LAST_WEIGHT = 0.4  # of the last joint in distances; the first joints sweep the largest volumes
WORTH = 0.99  # a shortcut that saves less is not checked


def connect(
    model: CollisionModel,
    start: Array,
    goal: Array,
    *,
    margin_m: float,
    check_rad: float,
    lower: Array,
    upper: Array,
    seed: int,
    rounds: int,
) -> Array | None:
    """Return a path (N, n) of free straight segments from start to goal, or None when the rounds are over.

    In each round one tree grows towards a random place between `lower` and `upper`, and the other one towards it.
    """
    places = np.random.default_rng(seed).uniform(lower, upper, (rounds, len(start)))
    weights = np.linspace(1.0, LAST_WEIGHT, len(start))
    path = grown(
        places, np.array([start, goal]), weights, check_rad, model.kinematics.dh, model.tool_ends, model.radii,
        model.rotations, model.middles, model.halves, model.watched, model.self_pairs, margin_m,
    )  # fmt: skip
    return path if len(path) else None


@compiled
def grown(
    places: Array,
    roots: Array,
    weights: Array,
    check_rad: float,
    dh: Array,
    tool_ends: Array,
    radii: Array,
    rotations: Array,
    middles: Array,
    halves: Array,
    watched: Mask,
    pairs: Index,
    margin: float,
) -> Array:
    """Grow a tree from each of the two `roots` (2, n) until they meet; returns the path between them, or none (0, n)."""
    n = roots.shape[1]
    trees, parents, counts = np.empty((2, ROOM, n)), np.full((2, ROOM), -1), np.ones(2, np.int64)
    trees[:, 0] = roots
    for row in range(places.shape[0]):
        side, target = row % 2, places[row]
        for grows in (side, 1 - side):
            how = CUT
            while True:
                if counts[grows] == trees.shape[1]:
                    trees, parents = with_room(trees), np.concatenate((parents, parents), axis=1)
                how = extended(
                    trees[grows], parents[grows], counts[grows], target, weights, check_rad, dh, tool_ends, radii,
                    rotations, middles, halves, watched, pairs, margin,
                )  # fmt: skip
                counts[grows] += how > BLOCKED
                if how != FREE or grows == side:
                    break
            if grows == side:
                if how == BLOCKED:
                    break
                target = trees[side, counts[side] - 1].copy()
            elif how == REACHED:
                return joined(trees, parents, counts)
    return np.empty((0, n))


@inlined
def extended(
    tree: Array,
    parents: Index,
    count: int,
    target: Array,
    weights: Array,
    check_rad: float,
    dh: Array,
    tool_ends: Array,
    radii: Array,
    rotations: Array,
    middles: Array,
    halves: Array,
    watched: Mask,
    pairs: Index,
    margin: float,
) -> int:
    """Make one step of a tree of `count` configurations towards `target`; returns how far it came."""
    near, least = 0, np.inf
    for i in range(count):
        total = 0.0
        for k in range(target.shape[0]):
            gap = (tree[i, k] - target[k]) * weights[k]
            total += gap * gap
        if total < least:
            near, least = i, total
    way = target - tree[near]
    length = np.max(np.abs(way))
    share = min(1.0, STEP_RAD / max(length, 1e-9))
    free = first_hit(
        dh, tree[near], tree[near] + share * way, check_rad, tool_ends, radii, rotations, middles, halves, watched,
        pairs, margin,
    )  # fmt: skip
    if free * share * length < min(LEAST_STEP_RAD, length):
        return BLOCKED
    tree[count] = target if free * share == 1.0 else tree[near] + free * share * way
    parents[count] = near
    return CUT if free < 1.0 else REACHED if share == 1.0 else FREE


@inlined
def with_room(trees: Array) -> Array:
    """Return the trees with room for twice as many configurations."""
    return np.concatenate((trees, np.empty_like(trees)), axis=1)


@inlined
def joined(trees: Array, parents: Index, counts: Index) -> Array:
    """Return the path from the first root to the second one through the newest configurations, which are the same."""
    n = trees.shape[2]
    steps = np.zeros(2, np.int64)
    for side in range(2):
        i = counts[side] - 1
        while i >= 0:
            steps[side] += 1
            i = parents[side, i]
    out = np.empty((steps[0] + steps[1] - 1, n))
    for side in range(2):
        i, row = counts[side] - 1, steps[0] - 1
        while i >= 0:
            out[row] = trees[side, i]
            i, row = parents[side, i], row + (1 if side else -1)
    return out


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
