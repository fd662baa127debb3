"""Selection of the taught examples worth keeping: those that the examples kept so far would misclassify.

Source: P. E. Hart, The condensed nearest neighbour rule, IEEE Trans. Inf. Theory 14(3), 1968, here with a margin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.finding.match import CLIP, distances
from perception.vision.knowledge import NOTHING, Knowledge
from perception.vision.look import WEIGHTS

# By which a look must be nearer to its own kind than to others, in units of likeness.
OBJECT_MARGIN, NOTHING_MARGIN = 0.2, 0.03
PASSES = 3  # at most, over all looks


def worth_keeping(
    looks: Array,
    names: NDArray[np.str_],
    spread: Array,
    *,
    known: Knowledge | None = None,
    weights: Array | None = None,
    nothing_margin: float = NOTHING_MARGIN,
) -> NDArray[np.int64]:
    """Return the indices of the looks to keep: those that known and kept looks do not classify correctly with a margin.

    Args:
        looks: (N, LENGTH).
        names: (N,) of their kinds.
        spread: (LENGTH,) the unit of likeness.
        known: knowledge from before; None for none. Of a kind that it does not have, the first look is kept.
        weights: (LENGTH,) of the numbers of a look; those of `known` by default.
        nothing_margin: margin for looks of the kind `nothing`.
    """
    if weights is None:
        weights = WEIGHTS if known is None else known.weights
    scaled, share = looks / spread, weights / weights.sum()
    margin = np.where(names == NOTHING, nothing_margin, OBJECT_MARGIN)
    own, other = _beforehand(looks, names, known)
    kept: list[int] = []

    def keep(i: int) -> None:
        distance = np.minimum(np.abs(scaled - scaled[i]), CLIP) @ share
        same = names == names[i]
        own[same] = np.minimum(own[same], distance[same])
        other[~same] = np.minimum(other[~same], distance[~same])
        kept.append(i)

    for name in sorted(set(names.tolist())):
        if known is None or known.kind(name) is None:
            keep(int(np.flatnonzero(names == name)[0]))
    order = np.random.default_rng(0).permutation(len(scaled))
    for _ in range(PASSES):
        before = len(kept)
        for i in order:
            if own[i] > 0 and own[i] > other[i] - margin[i]:
                keep(int(i))
        if len(kept) == before:
            break
    return np.array(kept, np.int64)


def _beforehand(looks: Array, names: NDArray[np.str_], known: Knowledge | None) -> tuple[Array, Array]:
    """Return distances (N,) to the nearest known look of the same kind, and of any other; infinite if there is none."""
    own, other = np.full(len(looks), np.inf), np.full(len(looks), np.inf)
    if known is None:
        return own, other
    for kind, distance in zip(known.kinds, distances(looks, known).T, strict=True):
        same = names == kind.name
        own[same] = distance[same]
        other[~same] = np.minimum(other[~same], distance[~same])
    return own, other
