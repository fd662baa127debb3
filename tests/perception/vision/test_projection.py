"""Views of a panel: their derivatives, and plates whose corners were clicked."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from hal.errors import InvalidRequest
from perception.vision.finding.plate_pose import rigid_plate
from perception.vision.projection import PanelProjection, PlateProjection, plate_by_corners

CORNERS_PX = np.array([[60.0, 20.0], [640.0, 45.0], [600.0, 420.0], [90.0, 400.0]])  # upper left first, clockwise
PLATE_M = (0.4, 0.3)
CORNERS_M = np.array([[-0.2, 0.15], [0.2, 0.15], [0.2, -0.15], [-0.2, -0.15]])
RIGID = rigid_plate(CORNERS_M, CORNERS_PX, focal_px=800.0, middle_px=np.array([320.0, 240.0]), sigma_px=6.0)
FREE = PlateProjection(px_from_plate=RIGID.px_from_plate, corners_m=CORNERS_M)


@pytest.mark.parametrize("view", [RIGID, FREE])
def test_derivatives_of_a_plate_agree_with_finite_differences(view: PanelProjection) -> None:
    points_m = np.random.default_rng(0).uniform(-0.2, 0.2, (9, 2))
    found = view.motion(points_m)
    for k, step in enumerate(np.diag(1e-4 * view.prior_sigma)):
        expected = (view.moved(step).project(points_m) - view.moved(-step).project(points_m)) / (2 * step[k])
        np.testing.assert_allclose(found[:, :, k], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_corners_in_any_order_give_the_same_upright_plate(order: tuple[int, ...]) -> None:
    view = plate_by_corners(CORNERS_PX[list(order)], PLATE_M)
    np.testing.assert_allclose(view.project(CORNERS_M), CORNERS_PX, atol=1e-9)


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
