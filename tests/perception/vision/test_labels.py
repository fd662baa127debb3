"""Labels in an image are beside their objects, do not overlap, and are not outside."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from perception.vision.labels import PixelBox, place_labels

PICTURE = (640, 480)


def overlaps_px(boxes: list[PixelBox]) -> list[int]:
    return [a.overlap_px(b) for a, b in combinations(boxes, 2)]


def test_a_lone_name_stands_flush_above_its_object() -> None:
    own = PixelBox(100, 200, 60, 40)
    (label,) = place_labels([own], [(90, 12)], PICTURE)
    assert (label.x, label.y + label.height) == (own.x, own.y - 4)


def test_overlap_is_the_common_area() -> None:
    a, b = PixelBox(0, 0, 10, 10), PixelBox(6, 7, 10, 10)
    assert a.overlap_px(b) == b.overlap_px(a) == 12
    assert a.overlap_px(PixelBox(10, 0, 5, 5)) == 0


@pytest.mark.parametrize("seed", range(5))
def test_names_of_a_crowded_panel_do_not_overlap(seed: int) -> None:
    """The panel has twenty small objects on a loose grid, whose labels are twice as wide as their distance."""
    rng = np.random.default_rng(seed)
    grid = [(60 + 130 * i, 60 + 95 * j) for i in range(5) for j in range(4)]
    objects = [PixelBox(int(x + rng.integers(-25, 25)), int(y + rng.integers(-20, 20)), 30, 30) for x, y in grid]
    sizes = [(int(rng.integers(100, 170)), 12) for _ in objects]
    flush = [PixelBox(own.x, own.y - 16, *size) for own, size in zip(objects, sizes, strict=True)]
    assert sum(overlaps_px(flush)) > 0, "the case must be a hard one"
    labels = place_labels(objects, sizes, PICTURE)
    assert sum(overlaps_px(labels)) == 0
    for label in labels:
        assert label.inside(*PICTURE) == label
    covered = [label.overlap_px(own) for label in labels for own in objects]
    assert sum(bool(area) for area in covered) <= 2, "there is room beside nearly all objects"


@pytest.mark.parametrize("own", [PixelBox(-20, -10, 40, 30), PixelBox(620, 460, 60, 60), PixelBox(0, 0, 640, 480)])
def test_a_name_stays_in_the_picture(own: PixelBox) -> None:
    (label,) = place_labels([own], [(120, 14)], PICTURE)
    assert label.inside(*PICTURE) == label


def test_a_name_wider_than_the_picture_begins_at_its_edge() -> None:
    (label,) = place_labels([PixelBox(300, 200, 20, 20)], [(900, 14)], PICTURE)
    assert label.x == 0
