"""Compares the contacts of regions and the unexplained pixels with the simplest implementation."""

from __future__ import annotations

from collections import defaultdict

import cv2
import numpy as np
import pytest

from perception.range.segmentation.borders import PAIR_POINTS, WIDEST_GAP_PX, touching
from perception.range.segmentation.unlabelled import unlabelled_patches

PACKED = np.array([1.0, 100.0, 120.0, 7.5, 4.0])


def patchwork(seed: int, shape: tuple[int, int] = (40, 50), labels: int = 90) -> np.ndarray:
    """Return (H, W) labels in patches of a few pixels, a third of them 0."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(1, labels + 1, (-(-shape[0] // 3), -(-shape[1] // 3)), dtype=np.int32)
    coarse[rng.random(coarse.shape) < 0.3] = 0
    return np.ascontiguousarray(np.kron(coarse, np.ones((3, 3), np.int32))[: shape[0], : shape[1]])


def plain_contacts(labels: np.ndarray) -> dict[tuple[int, int], list[tuple[float, float]]]:
    """Return the positions (u, v) of the contacts of each pair, row by row, the left neighbour before the upper one."""
    out = defaultdict(list)
    for v, row in enumerate(labels):
        for u, label in enumerate(row):
            sides = ((row[:u][::-1], (1.0, 0.0)), (labels[:v, u][::-1], (0.0, 1.0)))
            for line, (du, dv) in sides:
                seen = np.flatnonzero(line)
                if label and seen.size and seen[0] <= WIDEST_GAP_PX and line[seen[0]] != label:
                    back = 0.5 * (seen[0] + 1)
                    pair = (int(min(label, line[seen[0]])), int(max(label, line[seen[0]])))
                    out[pair].append((u - du * back, v - dv * back))
    return out


@pytest.mark.parametrize("seed", range(3))
def test_borders_are_the_contacts_of_every_pair_evenly_spread(seed):
    labels = patchwork(seed)
    pairs, lengths, x, y = touching(labels, PACKED)
    plain = plain_contacts(labels)
    assert sorted(map(tuple, pairs.tolist())) == sorted(plain)
    for pair, length, px, py in zip(map(tuple, pairs.tolist()), lengths, x, y, strict=True):
        places = plain[pair]
        count = min(len(places), PAIR_POINTS)
        u, v = np.array(places)[(np.arange(count) * len(places)) // count].T
        assert length == len(places)
        np.testing.assert_allclose(px[:count], (u - 7.5) / 100.0)
        np.testing.assert_allclose(py[:count], (v - 4.0) / 120.0)


def test_one_region_has_no_border():
    assert touching(np.ones((5, 6), np.int32), PACKED)[0].shape == (0, 2)
    assert touching(np.zeros((5, 6), np.int32), PACKED)[0].shape == (0, 2)


@pytest.mark.parametrize("seed", range(4))
def test_unexplained_patches_are_the_large_components_of_what_is_free(seed):
    rng = np.random.default_rng(seed)
    labels = (rng.random((37, 41)) < 0.55).astype(np.int32)
    depth = np.where(rng.random(labels.shape) < 0.05, np.nan, rng.random(labels.shape))
    free = ((labels == 0) & np.isfinite(depth)).astype(np.uint8)
    _, patch, boxes, _ = cv2.connectedComponentsWithStats(free, connectivity=8)
    large = boxes[:, cv2.CC_STAT_AREA] >= 20
    large[0] = False
    assert large.any()
    wanted = np.where(large[patch], depth, np.nan)
    (top, left), part = unlabelled_patches(depth, labels, 20, align_px=2)
    assert top % 2 == left % 2 == 0
    found = np.full(depth.shape, np.nan)
    found[top : top + part.shape[0], left : left + part.shape[1]] = part
    np.testing.assert_array_equal(found, wanted)
    rows, columns = np.nonzero(np.isfinite(wanted))
    assert (top, left) == (rows.min() // 2 * 2, columns.min() // 2 * 2)
    assert part.shape == (rows.max() + 1 - top, columns.max() + 1 - left)


def test_nothing_is_unexplained_where_all_is_labelled_or_missing():
    depth = np.ones((6, 6))
    depth[2] = np.nan
    labels = np.ones((6, 6), np.int32)
    labels[2:4] = 0
    assert unlabelled_patches(depth, labels, 7, align_px=1) is None
    assert unlabelled_patches(depth, labels, 6, align_px=1) is not None
