"""A hand that has turned a wheel by its spokes goes back to where its fingers were free before it moves back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.motion import CartesianPath
from hal.panel import Handwheel
from manipulation.skills.attempt import Attempt
from manipulation.skills.contact import relax
from manipulation.skills.turning import Felt
from manipulation.skills.wheel_turn import FREEING_N, PUSHING_FREE_N, WheelTurn

HUB_M = np.array([0.4, 0.1, 0.0])
TIPS = RigidTransform.from_components([0.4, 0.11, 0.02], Rotation.from_euler("x", np.pi))
WHEEL = SimpleNamespace(position_m=(0.4, 0.1))
UP_M = 0.05
PRESSED_N = 20.0


class Hand:
    """Attempt that keeps what is asked of it, at a pose that the test sets."""

    def __init__(self) -> None:
        self.here, self.asked = TIPS, list[CartesianPath]()
        self.left_m: list[float] = []
        self.is_wedged = False
        self.reports = [SimpleNamespace(wrench=np.array([0.0, PRESSED_N, 0.0, 0.0, 0.0, 0.0]))]
        identity = RigidTransform.identity()
        self.context = SimpleNamespace(panel_pose=identity, flange_from_grip=identity)

    def pose(self) -> RigidTransform:
        return self.here

    def run(self, motion: CartesianPath) -> None:
        self.asked.append(motion)
        if not self.is_wedged:
            self.here = motion.base_from_tool[-1] * motion.base_from_tool[0].inv() * self.here

    def open_to(self, _width_m: float, **_: Any) -> None:
        return None

    def leave(self, distance_m: float) -> None:
        self.left_m.append(distance_m)


def let_go(
    turned_rad: float,
    moved_rad: float,
    sign: float,
    *,
    felt: Felt,
    open_m: float | None = None,
    is_wedged: bool = False,
) -> Hand:
    """Return the hand that let go after it turned about the hub, and was pushed aside by 4 mm."""
    hand = Hand()
    hand.is_wedged = is_wedged
    turn = WheelTurn(
        attempt=cast(Attempt, hand), wheel=cast(Handwheel, WHEEL), sign=sign, behind_rad=0.2, most_nm=2.0, up_m=UP_M,
        open_m=open_m,
    )  # fmt: skip
    about = Rotation.from_rotvec([0.0, 0.0, -sign * turned_rad])
    place = HUB_M + about.apply(TIPS.translation - HUB_M) + [0.004, 0.0, 0.0]
    hand.here = RigidTransform.from_components(place, about * TIPS.rotation)
    turn.moved_rad, turn._felt = moved_rad, felt
    turn.let_go()
    return hand


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("moved_rad", [0.0, 1.2, 3.9])
def test_fingers_stand_to_the_spokes_as_when_they_came_down_before_the_hand_leaves(
    sign: float, moved_rad: float
) -> None:
    hand = let_go(moved_rad + 0.35, moved_rad, sign, felt=Felt())
    relax, free = hand.asked
    end = free.base_from_tool[-1]
    about = Rotation.from_rotvec([0.0, 0.0, -sign * moved_rad])
    assert (end.rotation * (about * TIPS.rotation).inv()).magnitude() == pytest.approx(0.0, abs=1e-6)
    ways_rad = [(p.rotation * free.base_from_tool[0].rotation.inv()).magnitude() for p in free.base_from_tool]
    assert max(ways_rad) == pytest.approx(0.35, abs=1e-6)  # back by the shorter way
    assert end.translation[:2] == pytest.approx(HUB_M[:2], abs=1e-9)
    assert free.guards[0].limit == FREEING_N
    assert (relax.name, hand.left_m) == ("relax", [UP_M])


def test_a_hand_that_friction_keeps_beside_its_place_is_pushed_there_once_more() -> None:
    _, softly, firmly = let_go(1.55, 1.2, 1.0, felt=Felt(), is_wedged=True).asked
    assert softly.compliance is not None and firmly.compliance is not None
    assert firmly.compliance.stiffness[0] > softly.compliance.stiffness[0]
    assert (softly.guards[0].limit, firmly.guards[0].limit) == (FREEING_N, PUSHING_FREE_N)
    assert firmly.base_from_tool[-1].translation[:2] == pytest.approx(HUB_M[:2], abs=1e-9)


@pytest.mark.parametrize(("felt", "open_m"), [(Felt(has_slipped=True), None), (Felt(), 0.03)])
def test_a_hand_that_slipped_or_held_the_rim_leaves_where_it_is(felt: Felt, open_m: float | None) -> None:
    hand = let_go(1.0, 0.8, 1.0, felt=felt, open_m=open_m)
    assert [motion.name for motion in hand.asked] == ["relax"]
    assert hand.left_m == [UP_M]


@pytest.mark.parametrize(
    ("wrench", "relaxes"), [([0.5, 0.5, 0.5, 0, 0, 0.05], 0), ([0, 0, 2.0, 0, 0, 0], 1), ([0] * 5 + [0.2], 1)]
)
def test_a_hand_on_which_nothing_presses_need_not_relax(wrench: list[float], relaxes: int) -> None:
    hand = Hand()
    hand.reports = [SimpleNamespace(wrench=np.array(wrench))]
    relax(cast(Attempt, hand))
    assert len(hand.asked) == relaxes
