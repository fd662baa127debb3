"""Visiting orders are optimal for few places, short for many, and leave out none."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from manipulation.planning.visiting_order import MOST_TRIED, visiting_order


def length_m(start: np.ndarray, places: np.ndarray, order: list[int]) -> float:
    return float(np.linalg.norm(np.diff([start, *places[order]], axis=0), axis=1).sum())


@pytest.mark.parametrize("count", [1, 3, 5])
def test_few_places_are_visited_on_the_shortest_way(count: int) -> None:
    random = np.random.default_rng(count)
    start, places = random.normal(size=3), random.normal(size=(count, 3))
    shortest = min(length_m(start, places, list(order)) for order in permutations(range(count)))
    assert length_m(start, places, visiting_order(start, places)) == pytest.approx(shortest)


def test_many_places_on_a_line_are_visited_one_after_the_other() -> None:
    places = np.array([[x, 0.0] for x in (5, 2, 9, 1, 7, 3, 8, 4, 6)], float)
    assert len(places) > MOST_TRIED
    assert [int(places[k][0]) for k in visiting_order((0.0, 0.0), places)] == list(range(1, 10))


def test_no_place_needs_no_way() -> None:
    assert visiting_order((0.0, 0.0), []) == []
