"""The whole chain gives the same result for any number of tiles."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perception.range import analyse
from tests.perception.range.scenes import PINHOLE, ball_on_table, noisy


def test_the_whole_chain_is_the_same_for_1_to_32_tiles():
    depth = noisy(ball_on_table().depth_m, 0.0005, seed=7, gross=0.01)
    one = analyse(depth, PINHOLE)
    with ThreadPoolExecutor(2) as pool:
        for tiles in (2, 5, 32):
            other = analyse(depth, PINHOLE, tiles=tiles, pool=pool)
            np.testing.assert_array_equal(one.labels, other.labels)
            for a, b in zip(one.surfaces, other.surfaces, strict=True):
                np.testing.assert_array_equal(a.covariance, b.covariance)
