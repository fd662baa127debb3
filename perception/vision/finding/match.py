"""Distances between the features of places and taught features: the nearest taught examples of every kind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind
from perception.vision.look import numbers_within

# Median increase of the distance from one nearest look of a kind to the next, in hard synthetic overviews.
NEXT_FURTHER = 0.02
CLIP = 3.0  # most that one number counts, in spreads, because glare or a cable may corrupt some numbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """Taught looks in the form that `nearest` reads: divided by their spread and multiplied by the weights.

    Attributes:
        columns: (LENGTH, M), one column per look, ordered by kind, so that the same number of all looks is contiguous.
        first: (kinds + 1,) first column of every kind, and the end of the last one.
        parts: (G + 1,) first column of every part of the columns whose looks have the same reach, and the end.
        gain: (G, LENGTH) factors by which looks are multiplied before they are compared with a part.
        most: (G, LENGTH) what each number adds to a distance at most.
    """

    columns: NDArray[np.float32]
    first: NDArray[np.int64]
    parts: NDArray[np.int64]
    gain: NDArray[np.float32]
    most: NDArray[np.float32]


@lru_cache(maxsize=4)
def prepared(knowledge: Knowledge) -> Prepared:
    """Prepare the taught features of all kinds for `nearest`; the result is cached per knowledge."""
    counts = [len(kind.looks) for kind in knowledge.kinds]
    reach_m = np.concatenate(
        [np.full(len(k.looks), np.inf) if k.reach_m is None else k.reach_m for k in knowledge.kinds]
    )
    parts = np.concatenate([[0], np.flatnonzero(reach_m[1:] != reach_m[:-1]) + 1, [len(reach_m)]])
    weights = knowledge.weights * [numbers_within(reach) for reach in reach_m[parts[:-1]]]
    weights = weights / weights.sum(axis=1, keepdims=True)
    gain = weights / knowledge.spread
    scaled = np.vstack([kind.looks for kind in knowledge.kinds]) * np.repeat(gain, np.diff(parts), axis=0)
    return Prepared(
        columns=np.ascontiguousarray(scaled.T, np.float32),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        parts=parts.astype(np.int64),
        gain=gain.astype(np.float32),
        most=(CLIP * weights).astype(np.float32),
    )


def distances(looks: Array, knowledge: Knowledge) -> Array:
    """Return the distance (N, kinds) of features (N, LENGTH) to the nearest taught example of every kind.

    The distance is the weighted mean of the absolute differences over the spread, each limited to `CLIP`; numbers beyond
    the reach of a taught example do not count.
    """
    return nearest(looks, prepared(knowledge))


def nearest(looks: Array, known: Prepared, *, mean_of: int = 1) -> Array:
    """Return `distances` to prepared examples.

    `mean_of`: number of nearest examples of every kind over which the distance is averaged. A missing example counts as
    `NEXT_FURTHER` more distant than the last, so that a kind with one example is neither preferred nor excluded.
    """
    kinds = np.tile(np.array([0, len(known.first) - 1]), (len(looks), 1))
    return _measured(looks, known, kinds, mean_of)


def nearest_of(looks: Array, known: Prepared, kinds: NDArray[np.int64]) -> Array:
    """Return the distance (N,) of each look to the nearest prepared example of its own kind (N,)."""
    return _measured(looks, known, np.column_stack([kinds, kinds + 1]), mean_of=1)[:, 0]


def _measured(looks: Array, known: Prepared, kinds: NDArray[np.int64], mean_of: int) -> Array:
    """Return the distances of each look to the kinds from `kinds[:, 0]` up to `kinds[:, 1]`, as many for each look."""
    columns = known.columns, known.first, known.parts, known.gain, known.most
    return np.asarray(_nearest(looks.astype(np.float32), *columns, kinds, mean_of), float)


def nearest_look(look: Array, kind: TaughtKind, knowledge: Knowledge) -> int:
    """Return the index of the look of a kind that is nearest to a look (LENGTH,)."""
    difference = np.minimum(np.abs(kind.looks - look) / knowledge.spread, CLIP)
    return int((difference @ knowledge.weights).argmin())


def nothing_column(knowledge: Knowledge) -> int | None:
    """Return the column of `distances` for the kind `nothing`; None if it is not taught."""
    names = [kind.name for kind in knowledge.kinds]
    return names.index(NOTHING) if NOTHING in names else None


@compiled
def _nearest(
    looks: NDArray[np.float32], columns: NDArray[np.float32], first: NDArray[np.int64], parts: NDArray[np.int64],
    gain: NDArray[np.float32], most: NDArray[np.float32], kinds: NDArray[np.int64], mean_of: int,
) -> NDArray[np.float32]:  # fmt: skip
    """Compute the distances of every place to the nearest looks of the kinds asked for, number by number.

    The inner loop is vectorised with an order of summation that does not depend on the processor.
    """
    n, length = looks.shape
    out = np.empty((n, kinds[0, 1] - kinds[0, 0] if n else 0), np.float32)
    for i in range(n):
        begin, end = first[kinds[i, 0]], first[kinds[i, 1]]
        total = np.zeros(end - begin, np.float32)
        for g in range(len(parts) - 1):
            a, b = max(parts[g], begin), min(parts[g + 1], end)
            if a >= b:
                continue
            part = total[a - begin : b - begin]
            for j in range(length):
                number, row, clip = looks[i, j] * gain[g, j], columns[j, a:b], most[g, j]
                for k in range(len(part)):
                    d = abs(number - row[k])
                    part[k] += d if d < clip else clip
        for c in range(out.shape[1]):
            k = kinds[i, 0] + c
            of_kind = total[first[k] - begin : first[k + 1] - begin]
            out[i, c] = of_kind.min() if mean_of == 1 else _mean_of_least(of_kind, mean_of, NEXT_FURTHER)
    return out


@inlined
def _mean_of_least(values: NDArray[np.float32], count: int, step: float) -> float:
    """Return the mean of the `count` least values; missing ones are extrapolated from the last by `step`."""
    least = np.full(count, np.inf)
    for value in values:
        if value < least[-1]:
            k = count - 1
            while k > 0 and least[k - 1] > value:
                least[k] = least[k - 1]
                k -= 1
            least[k] = value
    for k in range(len(values), count):
        least[k] = least[k - 1] + step
    return float(least.mean())
