"""Tests of where a hand goes from what one of its fingers has landed on."""

from __future__ import annotations

import numpy as np
import pytest

from manipulation.planning.hand import Hand
from manipulation.skills.landing import away_from_load

HAND = Hand()
OPEN_M = 0.043  # the middles of the fingers are then 25 mm from the middle of the hand


def loaded_at(x_m: float, y_m: float, force_n: tuple[float, float, float]) -> np.ndarray:
    """Return the wrench about the tips of a force at a point of the plane of the tips."""
    return np.concatenate([force_n, np.cross([x_m, y_m, 0.0], force_n)])


@pytest.mark.parametrize(
    ("x_m", "y_m", "expected"),
    [
        (0.028, 0.0, (-1.0, 0.0)),  # the outer edge of the right finger
        (0.022, 0.0, (1.0, 0.0)),  # its inner edge
        (-0.028, 0.0, (1.0, 0.0)),
        (-0.025, 0.006, (0.0, -1.0)),  # the front edge of the left finger
        (0.025, -0.006, (0.0, 1.0)),
    ],
)
def test_the_hand_goes_away_from_the_edge_that_is_loaded(x_m: float, y_m: float, expected: tuple[float, float]) -> None:
    aside = away_from_load(loaded_at(x_m, y_m, (0.0, 0.0, -8.0)), HAND, OPEN_M)
    assert aside is not None
    np.testing.assert_allclose(aside, [*expected, 0.0], atol=1e-9)


def test_a_flank_shows_the_way_itself() -> None:
    aside = away_from_load(loaded_at(0.022, 0.0, (-3.0, 0.0, -8.0)), HAND, OPEN_M)
    assert aside is not None
    np.testing.assert_allclose(aside, [-1.0, 0.0, 0.0])


def test_with_both_fingers_on_something_no_side_is_better() -> None:
    wrench = loaded_at(0.025, 0.0, (0.0, 0.0, -8.0)) + loaded_at(-0.025, 0.0, (0.0, 0.0, -8.0))
    assert away_from_load(wrench, HAND, OPEN_M) is None
