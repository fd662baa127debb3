"""Tests of the choice between the two holds of a handwheel, and of the whole turns that a look between two holds counts."""

from __future__ import annotations

import pytest

from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.crank import spoke_holds
from manipulation.skills.wheel_hold import PUSH_N, SIDE_N, Belief, Hold

HAND = Hand()
WHEEL = Handwheel(name="w", position_m=(0.0, 0.0), radius_m=0.030, spokes=3)
HOLDS = spoke_holds(WHEEL, HAND, 0.3, 1.0)
MOST_NM = 2.0 * PUSH_N * HOLDS[0].arm_m


def test_a_small_wheel_too_heavy_for_two_fingers_on_spokes_is_held_at_its_rim() -> None:
    assert Belief(effort_nm=0.9 * MOST_NM).prefers_spokes(WHEEL, HOLDS)
    assert not Belief(effort_nm=1.1 * MOST_NM).prefers_spokes(WHEEL, HOLDS)
    large = WHEEL.model_copy(update={"radius_m": 0.045})
    assert Belief(effort_nm=3.0).prefers_spokes(large, spoke_holds(large, HAND, 0.3, 1.0))


@pytest.mark.parametrize("effort_nm", [0.3, 3.0])
def test_a_hold_that_has_failed_gives_way_to_the_other(effort_nm: float) -> None:
    belief = Belief(effort_nm=effort_nm, failed={Hold.SPOKES})
    rim_is_enough = effort_nm < SIDE_N * WHEEL.radius_m
    assert belief.prefers_spokes(WHEEL, HOLDS) != rim_is_enough
    assert belief.has_another(WHEEL, HAND) == rim_is_enough
    belief = Belief(effort_nm=effort_nm, failed={Hold.RIM})
    assert belief.prefers_spokes(WHEEL, HOLDS)
    belief.failed.add(Hold.SPOKES)
    assert not belief.has_another(WHEEL, HAND)


def test_fingers_that_do_not_fit_between_the_spokes_hold_the_rim_and_have_no_other_hold() -> None:
    small = WHEEL.model_copy(update={"radius_m": 0.024})
    assert not Belief(effort_nm=0.3, failed={Hold.RIM}).prefers_spokes(small, spoke_holds(small, HAND, 0.0, 1.0))
    assert not Belief(effort_nm=0.3, failed={Hold.RIM}).has_another(small, HAND)
