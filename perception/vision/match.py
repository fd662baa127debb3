"""Likeness of places to taught looks: the nearest look of every kind, and what follows for the place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from perception.vision.knowledge import NOTHING, Knowledge
from perception.vision.view import Array

CLIP = 3.0  # one number counts for three spreads at most: glare or a cable spoils some numbers, whatever is there


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """Taught looks over their spread, one below the other, with the column of each one's kind: made once an image."""

    looks: Array
    owner: NDArray[np.int64]
    kinds: int
    spread: Array


def prepared(knowledge: Knowledge) -> Prepared:
    """The looks of all kinds as `nearest` wants them."""
    counts = [len(kind.looks) for kind in knowledge.kinds]
    return Prepared(
        looks=np.vstack([kind.looks for kind in knowledge.kinds]) / knowledge.spread,
        owner=np.repeat(np.arange(len(counts)), counts).astype(np.int64),
        kinds=len(counts),
        spread=knowledge.spread,
    )


def distances(looks: Array, knowledge: Knowledge) -> Array:
    """(N, kinds) distance of (N, LENGTH) looks to the nearest look of every kind, in spreads a number.

    The distance is the mean of the absolute differences over the spread, each limited to `CLIP`.
    """
    return nearest(looks, prepared(knowledge))


def nearest(looks: Array, known: Prepared) -> Array:
    """`distances` to looks that are prepared."""
    return np.asarray(_nearest(looks / known.spread, known.looks, known.owner, known.kinds))


def distances_reference(looks: Array, knowledge: Knowledge) -> Array:
    """The same as `distances`, in plain numpy."""
    columns = []
    for kind in knowledge.kinds:
        difference = np.abs(looks[:, None] - kind.looks[None]) / knowledge.spread
        columns.append(np.minimum(difference, CLIP).mean(axis=2).min(axis=1))
    return np.column_stack(columns)


def nothing_column(knowledge: Knowledge) -> int | None:
    """Column of `distances` that belongs to what is not an object."""
    names = [kind.name for kind in knowledge.kinds]
    return names.index(NOTHING) if NOTHING in names else None


@njit(cache=True)
def _nearest(looks: Array, known: Array, owner: NDArray[np.int64], kinds: int) -> Array:  # pragma: no cover
    """Branch and bound: a look is given up as soon as it is further than the best of its kind."""
    n, length = looks.shape
    out = np.full((n, kinds), CLIP * 1.0)
    for i in range(n):
        for k in range(len(known)):
            best = out[i, owner[k]] * length
            total = 0.0
            for j in range(length):
                d = abs(looks[i, j] - known[k, j])
                total += d if d < CLIP else CLIP
                if total >= best:
                    break
            if total < best:
                out[i, owner[k]] = total / length
    return out
