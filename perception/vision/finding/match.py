"""Distances between the features of places and taught features: the nearest taught examples of every kind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jit import compiled, inlined
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind

# Median increase of the distance from one nearest look of a kind to the next, in hard synthetic overviews.
NEXT_FURTHER = 0.02
CLIP = 3.0  # most that one number counts, in spreads, because glare or a cable may corrupt some numbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """Taught looks in the form that `nearest` reads: divided by their spread and multiplied by the weights.

    Attributes:
        columns: (LENGTH, M), one column per look, ordered by kind, so that the same number of all looks is contiguous.
        first: (kinds + 1,) first column of every kind, and the end of the last one.
        gain: (LENGTH,) factors by which looks are multiplied before they are compared.
        weights: (LENGTH,) of the numbers.
    """

    columns: NDArray[np.float32]
    first: NDArray[np.int64]
    gain: Array
    weights: Array


@lru_cache(maxsize=4)
def prepared(knowledge: Knowledge) -> Prepared:
    """Prepare the taught features of all kinds for `nearest`; the result is cached per knowledge."""
    counts = [len(kind.looks) for kind in knowledge.kinds]
    gain = knowledge.weights / knowledge.spread
    scaled = np.vstack([kind.looks for kind in knowledge.kinds]) * gain
    return Prepared(
        columns=np.ascontiguousarray(scaled.T, np.float32),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        gain=gain,
        weights=knowledge.weights,
    )


def distances(looks: Array, knowledge: Knowledge) -> Array:
    """Return the distance (N, kinds) of features (N, LENGTH) to the nearest taught example of every kind.

    The distance is the weighted mean of the absolute differences over the spread, each limited to `CLIP`.
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
    scaled = (looks * known.gain).astype(np.float32)
    clips = (CLIP * known.weights).astype(np.float32)
    total = float(known.weights.sum())
    found = _nearest(scaled, known.columns, known.first, kinds, clips, mean_of, NEXT_FURTHER * total)
    return np.asarray(found, float) / total


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
    looks: NDArray[np.float32],
    columns: NDArray[np.float32],
    first: NDArray[np.int64],
    kinds: NDArray[np.int64],
    clips: NDArray[np.float32],
    mean_of: int,
    step: float,
) -> NDArray[np.float32]:
    """Compute the distances of every place to the nearest looks of every kind, number by number.

    The inner loop is vectorised with an order of summation that does not depend on the processor.
    """
    n, length = looks.shape
    out = np.empty((n, kinds[0, 1] - kinds[0, 0] if n else 0), np.float32)
    for i in range(n):
        begin, end = first[kinds[i, 0]], first[kinds[i, 1]]
        total = np.zeros(end - begin, np.float32)
        for j in range(length):
            number, row, clip = looks[i, j], columns[j, begin:end], clips[j]
            for k in range(len(total)):
                d = abs(number - row[k])
                total[k] += d if d < clip else clip
        for c in range(out.shape[1]):
            k = kinds[i, 0] + c
            part = total[first[k] - begin : first[k + 1] - begin]
            out[i, c] = part.min() if mean_of == 1 else _mean_of_least(part, mean_of, step)
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
