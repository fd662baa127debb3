"""Tests of fingers and gripper pads whose readings are implausible."""

from __future__ import annotations

import numpy as np
import pytest

from hal.motion import GripperMotion, MotionOutcome, RobotState
from manipulation.control.sensing import DeviceFailure, refuse
from manipulation.plausibility.hand import (
    FELT_N,
    FREE_WAY_M,
    NEAR_TIPS_M,
    QUIET_S,
    UNFELT_S,
    Pads,
    TouchMonitor,
    wrong_width,
)
from tests.manipulation.rig import FakeForceTorque, FakeTouch, Rig, World, make_rig

DT_S = 0.002


# -- the gripper ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("begun_m", "sent_m", "said_m", "holding", "moving"),
    [
        (0.0, 0.034, 0.034, False, False),
        (0.0, 0.034, 0.0315, False, False),  # within the accuracy of grippers
        (0.034, 0.0, 0.014, True, False),  # an object between the pads
        (0.014, 0.0, 0.014, True, False),  # an object already held is gripped more firmly
        (0.034, 0.0, 0.020, False, True),  # slow pads still moving at the time limit
        (0.014, 0.034, 0.030, True, False),  # opening was stopped by an object
    ],
)
def test_what_a_healthy_gripper_says_is_believed(
    begun_m: float, sent_m: float, said_m: float, holding: bool, moving: bool
) -> None:
    refuse(
        wrong_width("pads", Pads(width_m=said_m, is_holding=holding, is_moving=moving), sent_m=sent_m, begun_m=begun_m)
    )


@pytest.mark.parametrize(
    ("begun_m", "sent_m", "said_m", "holding", "moving"),
    [
        (0.0, 0.034, 0.0, False, False),  # frozen closed
        (0.034, 0.0, 0.034, False, False),  # frozen open, and nothing is held
        (0.014, 0.034, 0.014, True, False),  # frozen while it held
        (0.0, 0.034, 0.0, False, True),  # frozen while it moved
        (0.044, 0.034, 0.044, False, False),  # 10 mm too much, always
        (0.044, 0.0, 0.010, False, False),
        (0.024, 0.0, -0.010, False, False),
    ],
)
def test_a_width_that_contradicts_its_command_names_the_gripper(
    begun_m: float, sent_m: float, said_m: float, holding: bool, moving: bool
) -> None:
    with pytest.raises(DeviceFailure, match=f"^pads was sent to {1e3 * sent_m:.1f} mm") as caught:
        refuse(
            wrong_width(
                "pads", Pads(width_m=said_m, is_holding=holding, is_moving=moving), sent_m=sent_m, begun_m=begun_m
            )
        )
    assert caught.value.device == "pads" and "switch the gripper off and on" in caught.value.cause


@pytest.fixture
def rig() -> Rig:
    made = make_rig()
    yield made  # type: ignore[misc]  # a generator fixture
    made.controller.close()


def opening(*, must_arrive: bool = True) -> GripperMotion:
    return GripperMotion(name="open", width_m=0.07, force_n=10.0, must_arrive=must_arrive)


def test_pads_that_say_they_did_not_move_end_the_motion_and_the_way_out_goes_on(rig: Rig) -> None:
    assert rig.controller.execute(opening()).outcome is MotionOutcome.COMPLETED

    def jam() -> None:
        rig.world.width_m = rig.world.width_target_m = 0.02

    rig.world.before_step = jam
    report = rig.controller.execute(opening())
    assert (report.outcome, report.device) == (MotionOutcome.FAULT, "gripper")
    assert "says 20.0 mm" in report.cause
    assert rig.controller.execute(opening(must_arrive=False)).outcome is MotionOutcome.COMPLETED
    state: RobotState = rig.controller.state()
    assert not state.is_stopped


# -- the fingers ---------------------------------------------------------------------------------------------------


class Hand:
    """Hand whose fingers and wrist report given readings, tick by tick."""

    def __init__(self, *, threshold_n: float = 0.5) -> None:
        world = World()
        self.watch = TouchMonitor(FakeTouch("finger_touch", world), FakeForceTorque("wrist_ft", world))
        self.now_s = 0.0
        self.tip_m = np.zeros(3)
        self.watch.begin(moves_pads=False)

    def opens(self) -> Hand:
        self.watch.begin(moves_pads=True)
        self.watch.pads_moved(0.0, Pads(width_m=0.034))
        self.watch.begin(moves_pads=False)
        return self

    def closes(self) -> Hand:
        self.watch.begin(moves_pads=True)
        self.watch.pads_moved(0.034, Pads(width_m=0.014, is_holding=True))
        self.watch.begin(moves_pads=False)
        return self

    def feels(
        self, force_n: float, *, lasting_s: float, fingers: bool, lever_m: float = 0.0, way_m: float = 0.0
    ) -> None:
        ticks = round(lasting_s / DT_S)
        for _ in range(ticks + 1):
            wrench = np.array([0.0, 0.0, -force_n, force_n * lever_m, 0.0, 0.0])
            refuse(self.watch.note((fingers, False), wrench, self.tip_m, stamp_s=self.now_s))
            self.now_s += DT_S
            self.tip_m = self.tip_m + np.array([way_m / ticks, 0.0, 0.0])


def test_a_push_on_the_tips_that_the_fingers_do_not_feel_names_them() -> None:
    with pytest.raises(DeviceFailure, match="finger_touch feels nothing while 9 N push on the tips") as caught:
        Hand().feels(9.0, lasting_s=UNFELT_S + DT_S, fingers=False)
    assert caught.value.device == "finger_touch" and "by hand" in caught.value.cause


def test_what_was_told_is_told_again_only_when_the_hand_had_time_to_leave() -> None:
    """If it were reported in every motion, the arm could not leave a button that it pushes with 14 N."""
    hand = Hand()
    with pytest.raises(DeviceFailure):
        hand.feels(14.0, lasting_s=1.0, fingers=False)
    hand.feels(14.0, lasting_s=0.95 * QUIET_S, fingers=False)
    with pytest.raises(DeviceFailure):
        hand.feels(14.0, lasting_s=0.1 * QUIET_S, fingers=False)


def test_short_touches_add_up_until_one_is_felt() -> None:
    hand = Hand()
    for _ in range(4):
        hand.feels(12.0, lasting_s=0.4 * UNFELT_S, fingers=False)
        hand.feels(12.0, lasting_s=DT_S, fingers=True)
    hand.feels(12.0, lasting_s=0.6 * UNFELT_S, fingers=False)
    with pytest.raises(DeviceFailure):
        hand.feels(12.0, lasting_s=0.6 * UNFELT_S, fingers=False)


@pytest.mark.parametrize(
    ("force_n", "lever_m"), [(0.9 * FELT_N, 0.0), (40.0, 1.1 * NEAR_TIPS_M)], ids=["weak", "on the hand's body"]
)
def test_what_need_not_reach_the_fingers_is_no_contradiction(force_n: float, lever_m: float) -> None:
    Hand().feels(force_n, lasting_s=1.0, fingers=False, lever_m=lever_m)


def test_a_finger_that_says_contact_all_along_a_free_way_names_itself() -> None:
    with pytest.raises(DeviceFailure, match="says contact while the open hand goes 150 mm"):
        Hand().opens().feels(1.0, lasting_s=1.0, fingers=True, way_m=1.1 * FREE_WAY_M)


def test_a_hand_that_carries_or_rubs_or_has_just_let_go_may_say_contact() -> None:
    Hand().closes().feels(1.0, lasting_s=1.0, fingers=True, way_m=1.0)
    Hand().feels(1.0, lasting_s=1.0, fingers=True, way_m=1.0)  # it is unknown what the hand holds
    Hand().opens().feels(6.0, lasting_s=1.0, fingers=True, way_m=1.0)
    hand = Hand().opens()
    for _ in range(5):
        hand.feels(1.0, lasting_s=0.2, fingers=True, way_m=0.9 * FREE_WAY_M)
        hand.feels(1.0, lasting_s=0.2, fingers=False, way_m=0.9 * FREE_WAY_M)


def test_fingers_are_believed_where_no_wrist_feels() -> None:
    world = World()
    for watch in (TouchMonitor(FakeTouch("finger_touch", world), None), TouchMonitor(None, None)):
        for tick in range(1000):
            wrench = np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0])
            assert watch.note((False, False), wrench, np.zeros(3), stamp_s=tick * DT_S) is None
