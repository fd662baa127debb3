"""Tests of the choice between the holds of a handwheel, and of what is learnt when one of them slips."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from hal.panel import Handwheel
from manipulation.planning.hand import Hand
from manipulation.skills.attempt import Attempt
from manipulation.skills.handwheel import _given_up, _has_longer_arm, _spokes
from manipulation.skills.outcome import Outcome
from manipulation.skills.wheel_belief import Belief, Hold, across_gap_m, torques_nm

HAND = Hand()
SMALL = Handwheel(name="w", position_m=(0.0, 0.0), radius_m=0.030, spokes=3)
LARGE = SMALL.model_copy(update={"radius_m": 0.045})


def test_a_small_wheel_is_held_across_and_one_wider_than_the_hand_behind_its_spokes() -> None:
    assert Belief(effort_nm=0.8).next_hold(SMALL, HAND) is Hold.ACROSS
    assert across_gap_m(LARGE, HAND) < 0.0
    assert Belief(effort_nm=0.8).next_hold(LARGE, HAND) is Hold.SPOKES


def test_the_hold_that_takes_most_is_tried_where_none_takes_the_effort() -> None:
    takes = torques_nm(SMALL, HAND)
    assert Belief(effort_nm=10.0).next_hold(SMALL, HAND) is max(takes, key=lambda hold: takes[hold])


def test_every_hold_is_tried_once_and_then_none_is_left() -> None:
    belief, tried = Belief(effort_nm=1.0), []
    while (hold := belief.next_hold(SMALL, HAND)) is not None:
        tried.append(hold)
        belief.failed.add(hold)
    assert sorted(tried) == sorted(torques_nm(SMALL, HAND))


def test_fingers_that_do_not_fit_between_the_spokes_do_not_try_them() -> None:
    assert Hold.SPOKES not in torques_nm(SMALL.model_copy(update={"radius_m": 0.024}), HAND)


def test_a_hold_across_that_the_wheel_did_not_follow_has_failed() -> None:
    belief = Belief(effort_nm=0.5)
    belief.turned(Hold.ACROSS, 0.0, 1.5)
    assert belief.learn(0.2) == pytest.approx(1.3)
    assert belief.failed == {Hold.ACROSS} and belief.has_slipped


@pytest.mark.parametrize("seen_rad", [1.5, 1.2, 0.8])
def test_a_wheel_that_followed_at_least_half_way_has_not_slipped(seen_rad: float) -> None:
    belief = Belief(effort_nm=0.5)
    belief.turned(Hold.SPOKES, 0.0, 1.5)
    assert belief.learn(seen_rad) == 0.0
    assert not belief.failed


def test_what_springs_back_when_the_wheel_is_let_go_is_added_to_the_next_turn() -> None:
    belief = Belief(effort_nm=2.0)
    belief.turned(Hold.ACROSS, 1.15, 1.97)
    belief.learn(1.87)
    assert belief.lost_rad == pytest.approx(0.05)
    belief.turned(Hold.ACROSS, 1.87, 1.97)  # by what was felt, less what is lost
    belief.learn(1.95)
    assert belief.lost_rad == pytest.approx(0.06)
    belief.turned(Hold.ACROSS, 1.95, 1.97)
    belief.learn(1.99)
    assert belief.lost_rad == pytest.approx(0.05)


def test_what_was_not_turned_teaches_nothing() -> None:
    assert Belief(effort_nm=0.5).learn(3.0) == 0.0


def test_a_wheel_that_never_moved_is_named_stiff_with_the_largest_torque_and_one_that_did_slipped() -> None:
    belief = Belief(effort_nm=0.8, failed=set(Hold))
    belief.begin(1.0)
    for torque_nm in (2.1, 2.9, 1.4):
        belief.felt(torque_nm)
    near = replace(belief, out_of_reach="no arm configuration follows the path, to hold it across")
    beyond = _given_up(near, 1.05)
    assert beyond.outcome is Outcome.UNREACHABLE and "the holds that are in reach turn it with 2.9 N m" in beyond.cause
    still, moved = _given_up(belief, 1.05), _given_up(belief, 1.6)
    assert (still.outcome, moved.outcome) == (Outcome.STIFF, Outcome.SLIPPED)
    assert "2.9 N m (holds: across, rim, spokes)" in still.cause
    belief.slipped(Hold.RIM)
    slipped = _given_up(belief, 1.05)
    assert slipped.outcome is Outcome.SLIPPED and "the pads slipped at 2.9 N m before" in slipped.cause


def test_spokes_that_did_not_do_are_pushed_further_from_the_hub_once() -> None:
    """410112 met the side force before the torque that its arm takes, and was called stiff; the longer arm turns it."""
    attempt, belief = cast(Attempt, SimpleNamespace(context=SimpleNamespace(hand=HAND))), Belief(effort_nm=0.5)
    wide_m = _spokes(attempt, LARGE, belief, 0.0, 1.0)[0].arm_m
    assert _has_longer_arm(attempt, LARGE, belief, wide_m)
    narrow_m = _spokes(attempt, LARGE, belief, 0.0, 1.0)[0].arm_m
    assert narrow_m > wide_m
    assert not _has_longer_arm(attempt, LARGE, belief, narrow_m)
