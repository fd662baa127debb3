"""Definition of the feature vector of a place on the plate, called a look: its numbers, their order and their weights.

A look (measured in `finding.features`) has one number per radius for each of `GROUPS`, then one number per direction
and ring for each of `AROUND_GROUPS`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_REACH_M = 0.008  # a look of a smaller place has too few numbers
RADII_M = np.arange(0.0015, 0.045, 0.003)  # of circles about the middle of the place
GROUPS = ("gray", "uneven", "edge", "strong_edge")
AROUND_GROUPS = ("gray_around", "edge_around")
DIRECTIONS = 8  # clockwise from straight up
RINGS = len(RADII_M) // 2  # two radii each; beyond the outermost are neighbouring objects
LENGTH = len(GROUPS) * len(RADII_M) + len(AROUND_GROUPS) * DIRECTIONS * RINGS


def numbers_within(reach_m: float) -> NDArray[np.bool_]:
    """Return which numbers (LENGTH,) of a look are of circles and rings within a distance from the middle."""
    circles, rings = reach_m > RADII_M, RADII_M[: 2 * RINGS : 2] < reach_m
    return np.concatenate([np.tile(circles, len(GROUPS)), np.tile(rings, len(AROUND_GROUPS) * DIRECTIONS)])


# Numbers that do not depend on the orientation count twice, so that both groups have about the same total weight.
WEIGHTS = np.repeat([2.0, 1.0], [len(GROUPS) * len(RADII_M), len(AROUND_GROUPS) * DIRECTIONS * RINGS])
# In a noisy image edges count more than gray, which the light changes; factors of 1.5 to 3 gave about the same results
# on overviews that were not used for teaching. Numbers beyond NOISY_REACH_M do not count, because glare, shadow and
# cables affect them as much as neighbouring objects do.
NOISY_REACH_M = 0.036
NOISY_WEIGHTS = np.repeat(
    [2.0, 2.0, 4.0, 4.0, 1.0, 1.5],  # of `GROUPS` and `AROUND_GROUPS`
    [*[len(RADII_M)] * len(GROUPS), *[DIRECTIONS * RINGS] * len(AROUND_GROUPS)],
) * numbers_within(NOISY_REACH_M)
