"""Tests of what is felt in a turn: pads that yield, friction that gives way, slips."""

from __future__ import annotations

import numpy as np
import pytest

from hal.arrays import Array
from manipulation.skills.turning import Felt, felt_in

FREE_RAD = 0.2


def torques(turned: Array, *, friction_nm: float, pads_nm_per_rad: float) -> Array:
    """Return the torque against a hand that meets the object after `FREE_RAD`."""
    noise = 0.005 * np.random.default_rng(3).standard_normal(len(turned))
    return np.clip(pads_nm_per_rad * (turned - FREE_RAD), 0.0, friction_nm) + noise


@pytest.mark.parametrize("friction_nm", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("pads_nm_per_rad", [3.0, 9.0])
def test_an_object_has_moved_by_the_turn_less_the_way_to_it_and_the_give_of_the_pads(
    friction_nm: float, pads_nm_per_rad: float
) -> None:
    turned = np.linspace(0.0, 2.0, 400)
    felt = felt_in(Felt(), turned, torques(turned, friction_nm=friction_nm, pads_nm_per_rad=pads_nm_per_rad))
    assert felt.is_moving
    assert not felt.has_slipped
    assert felt.running_nm == pytest.approx(friction_nm, rel=0.05)
    assert felt.moved_rad == pytest.approx(2.0 - FREE_RAD - friction_nm / pads_nm_per_rad, abs=0.05)


def test_a_finger_that_slides_before_both_push_is_not_the_object_that_gives_way() -> None:
    turned = np.linspace(0.0, 5.0, 1000)
    sliding = np.clip(2.0 * (turned - 0.02), 0.0, 0.3)
    torque = sliding + torques(turned, friction_nm=2.4, pads_nm_per_rad=9.0)
    felt = felt_in(Felt(), turned, torque)
    assert felt.running_nm == pytest.approx(2.7, rel=0.05)
    assert felt.moved_rad == pytest.approx(5.0 - FREE_RAD - 2.4 / 9.0, abs=0.1)


@pytest.mark.parametrize("end_rad", [0.3, 0.42, 0.5, 1.0])
def test_pads_that_settle_are_not_an_object_that_has_turned_with_more_before(end_rad: float) -> None:
    """The torque of pads that settle falls from 1.5 to 1.1 N m; the object gives way at 2.4 N m, after 0.42 rad."""
    turned = np.arange(0.0, end_rad, 0.002)
    torque = np.interp(turned, [0.2, 0.26, 0.32, 0.42], [0.0, 1.5, 1.1, 2.4])
    felt = felt_in(Felt(), turned, torque, ran_nm=2.4)
    assert felt.is_moving == (end_rad > 0.42)
    assert felt.moved_rad == pytest.approx(max(0.0, end_rad - 0.42), abs=0.04)


def test_an_object_that_has_become_lighter_is_felt_to_turn_after_a_while() -> None:
    turned = np.arange(0.0, 1.0, 0.002)
    felt = felt_in(Felt(), turned, torques(turned, friction_nm=0.6, pads_nm_per_rad=9.0), ran_nm=2.4)
    assert felt.running_nm == pytest.approx(0.6, rel=0.05)
    assert felt.moved_rad == pytest.approx(1.0 - FREE_RAD - 0.6 / 9.0, abs=0.05)


def test_an_object_that_only_loads_the_pads_has_not_moved() -> None:
    turned = np.linspace(0.0, 0.9, 300)
    felt = felt_in(Felt(), turned, torques(turned, friction_nm=9.0, pads_nm_per_rad=3.0))
    assert (felt.is_moving, felt.moved_rad, felt.has_slipped) == (False, 0.0, False)
    assert felt.peak_nm == pytest.approx(2.1, abs=0.05)


def test_at_an_end_stop_the_object_stays_while_the_hand_goes_on() -> None:
    first, second = np.linspace(0.0, 1.0, 200), np.linspace(1.0, 1.3, 100)
    before = felt_in(Felt(), first, torques(first, friction_nm=0.6, pads_nm_per_rad=3.0))
    felt = felt_in(before, second, 0.6 + 3.0 * (second - 1.0))
    assert before.moved_rad == pytest.approx(0.6, abs=0.04)
    assert felt.moved_rad == pytest.approx(0.6, abs=0.04)


def test_a_torque_that_falls_away_is_a_slip() -> None:
    turned = np.linspace(0.0, 1.0, 300)
    torque = torques(turned, friction_nm=9.0, pads_nm_per_rad=3.0)
    torque[200:] = 0.1
    assert felt_in(Felt(), turned, torque).has_slipped
