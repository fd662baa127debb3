"""Coplanar faces divided by a groove are two, wherever the labels end; things in front and contact prove nothing."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range.fitting.surfaces import PLANE, SIZE
from perception.range.noise import NoiseModel
from perception.range.segmentation import fillets
from perception.range.segmentation.join import join_pieces
from perception.range.segmentation.merge import merge_touching
from perception.range.segmentation.regions import Regions, regions_of
from perception.range.segmentation.seams import is_seam_grooved

SHAPE = (240, 320)
PACKED = np.array([1.0, 240.0, 240.0, 159.5, 119.5])
NOISE = NoiseModel(white=(0.001, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))
GROOVE = slice(158, 161)  # columns


def wall_with(depth_m: float, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a wall 2 m away with a groove of `depth_m` and 1 mm of noise, and the wall's parameters."""
    th = np.zeros(SIZE)
    th[:4] = np.array([slope, 0.0, -1.0, -2.0]) / np.hypot(slope, 1.0)
    x = (np.arange(SHAPE[1]) - PACKED[3]) / PACKED[1]
    depth = np.broadcast_to(th[3] / (th[0] * x + th[2]), SHAPE) + np.random.default_rng(5).normal(0.0, 0.001, SHAPE)
    depth[:, GROOVE] += depth_m
    return depth, th


def halves(seam: int) -> np.ndarray:
    """Return labels 1 and 2 that meet at a column, without the pixels of the groove."""
    labels = np.where(np.arange(SHAPE[1]) < seam, 1, 2) * np.ones((SHAPE[0], 1), int)
    labels[:, GROOVE] = 0
    labels[:15] = labels[-15:] = 0
    return labels.astype(np.int32)


def seam_of(column: int) -> tuple[np.ndarray, np.ndarray]:
    v = np.linspace(20, 220, 24)
    return np.full(24, (column - PACKED[3]) / PACKED[1]), (v - PACKED[4]) / PACKED[2]


def is_grooved(
    depth: np.ndarray, th: np.ndarray, labels: np.ndarray, column: int, own: tuple[int, ...] = (1, 2)
) -> bool:
    mine = np.isin(np.arange(labels.max() + 1), own)
    return bool(is_seam_grooved(depth, PACKED, NOISE.packed(), labels, mine, th, *seam_of(column)))


@pytest.mark.parametrize("slope", [0.0, 0.7])
@pytest.mark.parametrize("seam", [159, 154, 165])
def test_a_groove_shows_though_a_label_goes_on_beyond_it(slope, seam):
    depth, th = wall_with(0.02, slope)
    assert is_grooved(depth, th, halves(seam), seam)


@pytest.mark.parametrize("depth_m", [0.0, -0.02, 0.002])
def test_a_ridge_and_a_scratch_within_the_noise_are_no_groove(depth_m):
    depth, th = wall_with(depth_m, 0.0)
    assert not is_grooved(depth, th, halves(159), 159)


def test_a_groove_that_lies_between_others_parts_them_alone():
    depth, th = wall_with(0.02, 0.0)
    labels = halves(159)
    labels[:, 161:] = 3
    labels[:, 150:158] = np.where(labels[:, 150:158] > 0, 2, 0)
    assert not is_grooved(depth, th, labels, 150)


def regions(seam: int, depth_m: float) -> tuple[Regions, list[np.ndarray]]:
    depth, th = wall_with(depth_m, 0.0)
    return regions_of(depth, PACKED, NOISE.packed(), halves(seam), 2), [th.copy(), th.copy()]


@pytest.mark.parametrize("join", [merge_touching, join_pieces])
@pytest.mark.parametrize(("depth_m", "is_one"), [(0.02, False), (0.0, True)])
def test_halves_of_a_wall_are_one_unless_a_groove_parts_them(join, depth_m, is_one):
    image, parameters = regions(165, depth_m)
    joined = join(image, [PLANE, PLANE], parameters)
    assert (len(set(joined)) == 1) == is_one


def test_two_large_faces_that_touch_at_a_corner_are_not_merged():
    depth, th = wall_with(0.0, 0.0)
    labels = halves(159)
    labels[:, 156:164] = 0
    labels[120:128, 156:160], labels[120:128, 160:164] = 1, 2
    apart = regions_of(depth, PACKED, NOISE.packed(), labels, 2)
    assert merge_touching(apart, [PLANE, PLANE], [th.copy(), th.copy()]) == [1, 2]


@pytest.mark.parametrize(("depth_m", "left"), [(0.02, {2}), (0.0, {1})])
def test_a_strip_goes_to_the_face_beside_it_unless_a_groove_parts_them(depth_m, left):
    depth, th = wall_with(depth_m, 0.0)
    labels = halves(159)
    labels[:, 176:] = 0  # only a strip remains on the right
    kinds, table = np.array([0, PLANE, PLANE]), np.stack([np.zeros(SIZE), th, th])
    after = fillets.without_fillets(depth, PACKED, NOISE.packed(), labels, kinds, table)
    assert set(np.unique(after[20:220, 162:175])) == left
