"""The final refinement stays near the surface that it begins with."""

from __future__ import annotations

import numpy as np
import pytest

from perception.range.fitting.surfaces import CYLINDER, SIZE
from perception.range.noise import NoiseModel
from perception.range.segmentation.finish import refine_surface
from perception.range.segmentation.regions import regions_of
from tests.perception.range.reference import depths_on

SHAPE = (120, 160)
PACKED = np.array([1.0, 240.0, 240.0, 79.5, 59.5])
NOISE = NoiseModel(white=(0.001, 0.0), correlated=(0.0, 0.0), step=(0.0, 0.0))


@pytest.mark.parametrize("seed", range(3))
def test_a_face_that_hardly_bends_keeps_its_surface_before_the_sensor(seed):
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (u - PACKED[3]) / PACKED[1], (v - PACKED[4]) / PACKED[2]
    labels = np.zeros(SHAPE, np.int32)
    labels[52:68, 20:140] = 1
    hollow = 0.002 * (1.0 - (y * PACKED[2] / 8.0) ** 2)
    depth = 2.0 - hollow + np.random.default_rng(seed).normal(0.0, 0.001, SHAPE)
    start = np.zeros(SIZE)
    start[:8] = 0.0, 0.0, 10.0, 1.0, 0.0, 0.0, 8.0, 1.0
    regions = regions_of(depth, PACKED, NOISE.packed(), labels, 1)
    _, th = refine_surface(1, CYLINDER, start, regions, 1, noise=NOISE)
    z = depths_on(CYLINDER, th, x[labels == 1], y[labels == 1], True)
    np.testing.assert_allclose(z, depth[labels == 1], atol=0.02)
