"""A plate whose corners were clicked: their order does not matter, and what is no quadrangle is refused."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from hal.errors import InvalidRequest
from perception.vision.projection import plate_by_corners

CORNERS_PX = np.array([[60.0, 20.0], [640.0, 45.0], [600.0, 420.0], [90.0, 400.0]])  # upper left first, clockwise
PLATE_M = (0.4, 0.3)


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_corners_in_any_order_give_the_same_upright_plate(order: tuple[int, ...]) -> None:
    view = plate_by_corners(CORNERS_PX[list(order)], PLATE_M)
    corners_m = np.array([[-0.2, 0.15], [0.2, 0.15], [0.2, -0.15], [-0.2, -0.15]])
    np.testing.assert_allclose(view.project(corners_m), CORNERS_PX, atol=1e-9)


@pytest.mark.parametrize(
    "corners_px",
    [
        [[0, 0], [100, 0], [200, 0], [300, 0]],
        [[0, 0], [100, 0], [0, 100], [20, 20]],
        [[0, 0], [0, 0], [100, 0], [100, 100]],
        [[5, 5], [5, 5], [5, 5], [5, 5]],
    ],
)
def test_what_is_no_convex_quadrangle_is_refused(corners_px: list[list[float]]) -> None:
    with pytest.raises(InvalidRequest, match="corners"):
        plate_by_corners(corners_px, PLATE_M)
