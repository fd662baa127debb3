"""The numbers of a look: which there are, in which order, and what each counts.

A look is what a place on the plate looks like (measured in `finding.features`): `GROUPS`, one number per radius, then
`AROUND_GROUPS`, one number per direction and ring.
"""

from __future__ import annotations

import numpy as np

RADII_M = np.arange(0.0015, 0.045, 0.003)  # of the circles about the middle of the place
GROUPS = ("gray", "uneven", "edge", "strong_edge")
AROUND_GROUPS = ("gray_around", "edge_around")
DIRECTIONS = 8  # clockwise from straight up
RINGS = len(RADII_M) // 2  # two radii each; the outermost is left to neighbours
LENGTH = len(GROUPS) * len(RADII_M) + len(AROUND_GROUPS) * DIRECTIONS * RINGS
# What is the same whichever way a thing is turned counts twice per number, so as much as what lies in which direction.
WEIGHTS = np.repeat([2.0, 1.0], [len(GROUPS) * len(RADII_M), len(AROUND_GROUPS) * DIRECTIONS * RINGS])
# Of a noisy image edges count more than gray, which its light changes (1.5 to 3 times as much does nearly as well on overviews
# that were not taught on), and what lies further out nothing: glare, shadow and cables make as much of it as the neighbours.
NOISY_REACH_M = 0.036
NOISY_WEIGHTS = (
    np.repeat(
        [2.0, 2.0, 4.0, 4.0, 1.0, 1.5],  # of `GROUPS` and `AROUND_GROUPS`
        [*[len(RADII_M)] * len(GROUPS), *[DIRECTIONS * RINGS] * len(AROUND_GROUPS)],
    )
    * np.concatenate(
        [
            np.tile(RADII_M < NOISY_REACH_M, len(GROUPS)),
            np.tile(RADII_M[: 2 * RINGS : 2] < NOISY_REACH_M, len(AROUND_GROUPS) * DIRECTIONS),
        ]
    )
)
