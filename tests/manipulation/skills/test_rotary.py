"""Tests of the turn of a selector: its planned way, and the detents that are counted in its torque."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hal.panel import Rotary
from hal.strict import validate
from manipulation.skills.rotary import MOST_GIVE_RAD, PLAY_RAD, detents_passed, turn_bar

STATES = [{"name": "off", "angle_rad": -0.8}, {"name": "auto", "angle_rad": 0.0}, {"name": "on", "angle_rad": 0.8}]
SELECTOR = {"kind": "rotary", "name": "mode", "position_m": [0.1, 0.2], "radius_m": 0.018, "states": STATES}


class Planned(Exception):
    """The strokes between which the arm was to choose."""


class Plans:
    """An attempt that ends where its strokes are chosen."""

    def begin(self, options: Any, **_given: Any) -> int:
        raise Planned(options)


@pytest.mark.parametrize(("start_rad", "goal_rad"), [(-0.8, 0.8), (0.8, 0.0), (0.0, 0.8)])
@pytest.mark.parametrize("detents", [0, 1])
def test_the_planned_way_is_as_long_as_the_hand_may_turn(start_rad: float, goal_rad: float, detents: int) -> None:
    selector = validate(SELECTOR, Rotary, source="test")
    attempt: Any = Plans()
    with pytest.raises(Planned) as planned:
        turn_bar(attempt, selector, start_rad, goal_rad, over_rad=PLAY_RAD, detents=detents)
    most_rad = abs(goal_rad - start_rad) + PLAY_RAD + MOST_GIVE_RAD * detents
    (ways,) = planned.value.args
    for _standoff, first, *_between, last in ways:
        turned = (last.rotation * first.rotation.inv()).as_rotvec()
        assert turned == pytest.approx([0.0, 0.0, -np.sign(goal_rad - start_rad) * most_rad])


@pytest.mark.parametrize("detents", [0, 1, 3])
@pytest.mark.parametrize("effort_nm", [0.08, 0.3])
def test_each_fall_of_the_torque_is_one_detent(detents: int, effort_nm: float) -> None:
    """The pads load up to the middle between two places, then the selector runs ahead to the next."""
    resists = np.concatenate([np.linspace(0.0, effort_nm, 40), np.full(30, effort_nm)])
    snaps = np.linspace(-0.5 * effort_nm, 0.0, 20)
    torque = np.concatenate([*([resists, snaps] * detents), 0.4 * resists])
    noise = 0.004 * np.random.default_rng(5).standard_normal(len(torque))
    assert detents_passed(torque + noise) == detents
