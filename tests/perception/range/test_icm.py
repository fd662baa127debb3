"""Pixels between equally good surfaces follow their neighbours; compares the compiled sweep with its definition."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from perception.range.segmentation import boundary_pixels, icm
from perception.range.segmentation.pixel_assignment import ASSIGNMENT_SIGMAS, PLAIN_SIGMAS, misfit
from tests.perception.range.scenes import PARALLEL, PINHOLE
from tests.perception.range.test_pixel_assignment import KINDS, NOISE, competing_surfaces, random_case

SLOW_SHARE = 0.4


def swept(sensor, depth, labels, rows, columns, cuts=(0.0, 0.4, 1.0)):
    """Return the labels after one compiled sweep over the pixels, in several parts, and the pixels that changed."""
    names, after = np.full_like(rows, -1), labels.copy()
    ends = (np.array(cuts) * rows.size).astype(int).tolist()
    judge = partial(icm.icm_sweep, depth, sensor.packed(), NOISE.packed(), SLOW_SHARE, labels, KINDS)
    for first, last in pairwise(ends):
        judge(competing_surfaces(), rows, columns, names, first, last)
    return after, boundary_pixels.renamed_pixels(after, rows, columns, names)


def settled_label(sensor, depth, labels, v, u):
    """Return the label of one pixel by definition: half the squared residual plus a penalty for other labels around."""
    packed, z, table, reach = sensor.packed(), depth[v, u], competing_surfaces(), icm.REACH_PX
    top, left = max(v - reach, 0), max(u - reach, 0)
    patch = labels[top : v + reach + 1, left : u + reach + 1].copy()
    patch[v - top, u - left] = 0
    present, votes = np.unique(patch[patch > 0], return_counts=True)
    beside = labels[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
    if not np.isfinite(z) or not set(beside[beside > 0]) - {labels[v, u]}:
        return labels[v, u]
    evidence = 0.5 / (1.0 + SLOW_SHARE * (icm.SHARED_PX - 1.0))
    at = ((u - packed[3]) / packed[1], (v - packed[4]) / packed[2], z, float(NOISE.sigma_m(z)), bool(packed[0] > 0))
    misfits = np.array([misfit(KINDS[k], table[k], *at) for k in present])
    safe = np.count_nonzero(beside == labels[v, u]) > icm.SAFE_NEIGHBOURS
    if safe and labels[v, u] > 0 and misfit(KINDS[labels[v, u]], table[labels[v, u]], *at) < PLAIN_SIGMAS:
        return labels[v, u]
    cost = evidence * misfits**2 + icm.NEIGHBOUR_WEIGHT * (1.0 - votes / votes.sum())
    cost[misfits >= ASSIGNMENT_SIGMAS] = np.inf
    best = int(np.argmin(cost))
    if np.isfinite(cost[best]):
        return present[best]
    return labels[v, u]


@pytest.mark.parametrize("sensor", [PINHOLE, PARALLEL], ids=["pinhole", "orthographic"])
def test_a_sweep_is_its_definition(sensor):
    depth, labels = random_case(sensor, 4, size=1)
    out, _ = swept(sensor, depth, labels, *boundary_pixels.contested_pixels(labels, 1, 0, 120))
    assert (out != labels).any()
    rng = np.random.default_rng(0)
    for v, u in zip(rng.integers(0, 120, 1500), rng.integers(0, 160, 1500), strict=True):
        assert out[v, u] == settled_label(sensor, depth, labels, v, u)


def test_pixels_around_which_nothing_changed_need_not_be_judged_again():
    depth, labels = random_case(PINHOLE, 5, size=1)
    pixels = boundary_pixels.contested_pixels(labels, 1, 0, 120)
    for _ in range(4):
        after, moved = swept(PINHOLE, depth, labels, *pixels)
        everywhere, _ = swept(
            PINHOLE, depth, labels, *boundary_pixels.contested_pixels(labels, 1, 0, 120), cuts=(0.0, 1.0)
        )
        np.testing.assert_array_equal(after, everywhere)
        np.testing.assert_array_equal(np.nonzero(after != labels), np.unique(moved, axis=1))
        pixels, labels = boundary_pixels.pixels_around(*moved, icm.REACH_PX, labels.shape), after
