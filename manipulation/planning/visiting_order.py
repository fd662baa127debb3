"""The order in which to visit places so that the path is short, because the speed of the arm's tip is limited."""

from __future__ import annotations

from itertools import pairwise, permutations, starmap

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array

MOST_TRIED = 6  # 720 orders; more places are visited nearest first


def visiting_order(start_m: ArrayLike, places_m: ArrayLike) -> list[int]:
    """Return the indices of the places (N, k) in the order of a short path from `start_m` (k,) through them all, m.

    It is the shortest of all orders for at most `MOST_TRIED` places, and always the nearest next place for more.
    """
    start, places = np.asarray(start_m, float), np.asarray(places_m, float)
    points = np.vstack([start, places.reshape(-1, len(start))])
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1)
    count = len(places)
    if count <= MOST_TRIED:
        best = min(permutations(range(1, count + 1)), key=lambda order: _length(gaps, (0, *order)))
        return [k - 1 for k in best]
    order = [0]
    while len(order) <= count:
        order.append(min(set(range(1, count + 1)) - set(order), key=lambda k: (gaps[order[-1], k], k)))
    return [k - 1 for k in order[1:]]


def _length(gaps: Array, order: tuple[int, ...]) -> float:
    return sum(starmap(gaps.item, pairwise(order)))
