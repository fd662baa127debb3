"""Tests of how the benchmark judges third-party segmenters, which themselves are not installed for tests."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType

import numpy as np

from benchmarks.range_peers import Found, _greedy, _labelled
from hal.arrays import Array


def test_a_surface_in_two_parts_of_the_image_is_two_regions_and_holes_belong_to_none() -> None:
    points = np.zeros((20, 30, 3))
    points[:, 14:16] = np.nan  # divides the image
    points[:, 16:, 2] = 1.0

    def everything(_: ModuleType, left: Array) -> Iterator[Found]:
        yield np.ones(len(left), np.bool_), {"type": "plane"}

    labels, primitives = _labelled(everything, sys, points)
    assert sorted(np.unique(labels)) == [0, 1, 2] and [p["id"] for p in primitives] == [1, 2]
    assert not labels[:, 14:16].any() and len(np.unique(labels[:, :14])) == 1


def test_the_greedy_search_takes_the_largest_first_and_ends_when_little_is_left() -> None:
    points = np.repeat(np.arange(3.0), [600, 300, 3])[:, None] * np.ones(3)

    def largest(left: Array) -> tuple[np.ndarray, dict[str, float]]:
        values, counts = np.unique(left[:, 0], return_counts=True)
        value = float(values[counts.argmax()])
        return np.flatnonzero(left[:, 0] == value), {"value": value}

    found = list(_greedy(points, largest))
    assert [primitive["value"] for _, primitive in found] == [0.0, 1.0]
    assert [int(inside.sum()) for inside, _ in found] == [600, 300]
