"""Tests of the hand that a cell file describes."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import HandSection, load_cell
from hal.errors import Unsupported
from hal.geometry import identity
from manipulation.planning.hand import Hand

ROOT = Path(__file__).resolve().parents[3]
ONE = HandSection(fingers=1, finger_thickness_m=0.014)


def test_the_default_of_a_cell_file_is_the_default_hand() -> None:
    assert Hand.of(HandSection()) == Hand()


def test_a_cell_file_states_the_size_of_the_fingers() -> None:
    hand = Hand.of(HandSection(finger_thickness_m=0.01, finger_width_m=0.02, finger_length_m=0.1))
    assert hand.closed_half_m == (0.01, 0.01)
    finger = hand.capsules(identity(), 0.03)[0]
    assert finger.start_m == pytest.approx((-0.02, 0.0, -0.1))


def test_one_rigid_finger_is_as_thick_as_it_is_and_in_the_middle() -> None:
    hand = Hand.of(ONE)
    assert hand.closed_half_m == (0.007, 0.006)
    assert [capsule.name for capsule in hand.capsules(identity(), 0.0)][:2] == ["finger_left", "body_left"]
    assert hand.capsules(identity(), 0.0)[0].start_m == pytest.approx((0.0, 0.0, -0.075))


def test_one_rigid_finger_refuses_to_open_and_pushes() -> None:
    hand = Hand.of(ONE)
    hand.check_opens(0.0)
    with pytest.raises(Unsupported, match="open by 20 mm, and the hand is one rigid finger"):
        hand.check_opens(0.02)
    Hand().check_opens(0.08)


def test_the_shipped_cell_with_a_rigid_finger_has_no_opening() -> None:
    assert Hand.of(load_cell(ROOT / "cells/finger.toml").file.hand).max_width_m == 0.0
