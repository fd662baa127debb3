"""Tests of each guard: what it measures, in which tick it trips, and what does not trip it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.motion import Guard, Hold, JointTrajectory, MotionOutcome, Quantity, Reaction
from manipulation.control.guards import GuardSet, Measured
from manipulation.control.sensing import Sample, ToolReading
from manipulation.control.termination import TRANSFER_FORCE_N, TerminationMonitor, force_limit_n

START = RigidTransform.from_components([0.4, -0.1, 0.5], Rotation.from_euler("z", 90, degrees=True))
BEYOND = 1e-9


def measured(**given: Any) -> Measured:
    """Return a tick at the start pose without contact."""
    quiet: dict[str, Any] = {
        "elapsed_s": 0.0,
        "wrench": np.zeros(6),
        "base_from_tool": START.as_matrix(),
        "commanded_tip_m": START.translation,
        "contacts": (False, False),
        "proximity_m": (float("nan"), float("nan")),
    }
    return Measured(**{**quiet, **given})


def moved(shift_m: tuple[float, float, float], turn_rad: float = 0.0) -> dict[str, Any]:
    """Return a tick with the tool shifted in base axes and rotated about base x, but commanded to its start pose."""
    pose = RigidTransform.from_components(
        START.translation + shift_m, Rotation.from_rotvec([turn_rad, 0.0, 0.0]) * START.rotation
    )
    return {"base_from_tool": pose.as_matrix()}


X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
NAN = float("nan")


@pytest.mark.parametrize(
    ("quantity", "axis", "given", "value"),
    [
        (Quantity.FORCE, None, {"wrench": np.array([2.0, -3.0, 6.0, 9.0, 9.0, 9.0])}, 7.0),
        (Quantity.FORCE, Y, {"wrench": np.array([2.0, -3.0, 6.0, 9.0, 9.0, 9.0])}, -3.0),
        (Quantity.RESISTANCE, None, {"wrench": np.array([2.0, -3.0, 6.0, 9.0, 9.0, 9.0])}, 7.0),
        (Quantity.TORQUE, None, {"wrench": np.array([9.0, 9.0, 9.0, 2.0, -3.0, 6.0])}, 7.0),
        (Quantity.TORQUE, Y, {"wrench": np.array([9.0, 9.0, 9.0, 2.0, -3.0, 6.0])}, -3.0),
        (Quantity.TOUCH, None, {"contacts": (True, False)}, 1.0),
        (Quantity.PROXIMITY, None, {"proximity_m": (0.05, NAN, 0.03)}, 0.03),
        (Quantity.TRAVEL, None, moved((0.02, -0.03, 0.06)), 0.07),
        (Quantity.TRAVEL, X, moved((0.02, -0.03, 0.06)), -0.03),  # the tool's x is the base's y
        (Quantity.ROTATION, None, moved((0.5, 0.5, 0.5), -0.4), 0.4),
        (Quantity.TRACKING, None, moved((0.02, -0.03, 0.06)), 0.07),
    ],
)
@pytest.mark.parametrize("below", [False, True])
def test_a_guard_trips_at_its_limit_and_not_before(
    quantity: Quantity, axis: tuple[float, float, float] | None, given: dict[str, Any], value: float, below: bool
) -> None:
    def trips(limit: float) -> bool:
        guard = Guard(name="g", quantity=quantity, limit=limit, axis=axis, below=below, ticks=1)
        return GuardSet((guard,), START.as_matrix()).tripped(measured(**given)) is guard

    away = BEYOND if below else -BEYOND
    assert trips(value + away)
    assert not trips(value - away)


@pytest.mark.parametrize("below", [False, True])
def test_a_limit_that_is_just_met_trips(below: bool) -> None:
    guard = Guard(name="g", quantity=Quantity.TOUCH, limit=1.0, below=below, ticks=1)
    assert GuardSet((guard,), START.as_matrix()).tripped(measured(contacts=(True, False))) is guard


def test_a_guard_holds_for_its_ticks_without_a_gap() -> None:
    guard = Guard(name="g", quantity=Quantity.TOUCH, limit=1.0, ticks=3)
    guards = GuardSet((guard,), START.as_matrix())
    felt = [True, True, False, True, True, True]
    tripped = [guards.tripped(measured(contacts=(is_felt,))) is guard for is_felt in felt]
    assert tripped == [False, False, False, False, False, True]


@pytest.mark.parametrize("below", [False, True])
def test_nothing_in_range_trips_no_proximity_guard_and_breaks_its_row(below: bool) -> None:
    guard = Guard(name="g", quantity=Quantity.PROXIMITY, limit=0.04, below=below, ticks=2)
    guards = GuardSet((guard,), START.as_matrix())
    near = 0.03 if below else 0.05
    seen = [(NAN,), (NAN,), (near,), (NAN,), (near,), (near,)]
    assert [guards.tripped(measured(proximity_m=s)) is guard for s in seen] == [False] * 5 + [True]


def test_the_first_of_two_guards_is_named_and_both_keep_count() -> None:
    later = Guard(name="later", quantity=Quantity.FORCE, limit=1.0, ticks=2)
    first = Guard(name="first", quantity=Quantity.TOUCH, limit=1.0, ticks=2)
    guards = GuardSet((first, later), START.as_matrix())
    push = np.array([5.0, 0, 0, 0, 0, 0])
    assert guards.tripped(measured(wrench=push)) is None
    assert guards.tripped(measured(wrench=push, contacts=(True,))) is later
    assert guards.tripped(measured(wrench=push, contacts=(True,))) is first


# -- what ends a motion --------------------------------------------------------------------------------------------


def look(force_n: float = 0.0, *, behind_m: float = 0.0) -> ToolReading:
    """Return a tick with a force along -z and a tool that lags behind its command."""
    return ToolReading(
        wrench=np.array([0.0, 0.0, -force_n, 0.0, 0.0, 0.0]),
        base_from_tool=START.as_matrix(),
        commanded_tip_m=START.translation + np.array([0.0, behind_m, 0.0]),
    )


SAMPLE = Sample(
    stamp_s=0.0,
    position_rad=np.zeros(6),
    velocity_rad_per_s=np.zeros(6),
    raw_wrench=np.zeros(6),
    contacts=(False, False),
    proximity_m=(),
    gripper_width_m=0.0,
    gripper_is_moving=False,
)


def watch(
    *guards: Guard, at_start: ToolReading | None = None, latched: bool = False, cancelled: bool = False
) -> TerminationMonitor:
    return TerminationMonitor(
        guards, 100.0, at_start or look(), arm="left_arm", is_latched=lambda: latched, is_cancelled=lambda: cancelled
    )


def endings(watched: TerminationMonitor, seen: ToolReading, ticks: int) -> list[MotionOutcome | None]:
    """Return the result of each tick."""
    found = [watched.ending(0.002 * tick, SAMPLE, seen) for tick in range(ticks)]
    return [None if end is None else end.outcome for end in found]


def test_a_stop_comes_before_a_cancel_and_a_cancel_before_a_guard() -> None:
    guard = Guard(name="g", quantity=Quantity.FORCE, limit=1.0, ticks=1)
    assert endings(watch(guard, latched=True, cancelled=True), look(5.0), 1) == [MotionOutcome.STOPPED]
    assert endings(watch(guard, latched=True), look(5.0), 1) == [MotionOutcome.STOPPED]
    assert endings(watch(guard, cancelled=True), look(5.0), 1) == [MotionOutcome.CANCELLED]
    assert endings(watch(guard), look(5.0), 1) == [MotionOutcome.GUARD]
    assert endings(watch(guard), look(0.5), 1) == [None]


def test_a_guard_that_means_a_fault_ends_in_one_and_says_at_most_or_at_least() -> None:
    low = Guard(name="low", quantity=Quantity.FORCE, limit=1.5, below=True, ticks=1, reaction=Reaction.FAULT)
    end = watch(low).ending(0.0, SAMPLE, look())
    assert end is not None
    assert (end.outcome, end.tripped, end.cause) == (MotionOutcome.FAULT, "low", "guard low: force at most 1.5 N")
    end = watch(replace(low, below=False)).ending(0.0, SAMPLE, look(2.0))
    assert end is not None and end.cause == "guard low: force at least 1.5 N"


@pytest.mark.parametrize(("loaded_n", "limit_n"), [(0.0, 100.0), (80.0, 100.0), (99.0, 100.0), (120.0, 130.0)])
def test_the_force_limit_always_holds_and_a_start_beyond_it_may_hardly_grow(loaded_n: float, limit_n: float) -> None:
    for force_n, outcome in ((limit_n - 1e-6, None), (limit_n + 1e-6, MotionOutcome.FAULT)):
        assert endings(watch(at_start=look(loaded_n)), look(force_n), 2) == [None, outcome]


@pytest.mark.parametrize(
    ("force_n", "expected"),
    [((0.0, 0.0, -140.0), None), ((0.0, 0.0, 140.0), MotionOutcome.FAULT), ((140.0, 0.0, -140.0), MotionOutcome.FAULT)],
)
def test_a_hand_that_is_pushed_out_goes_on_with_its_retreat(
    force_n: tuple[float, float, float], expected: MotionOutcome | None
) -> None:
    """The tool's z is the base's, and the retreat goes along -z: what pushes along +z or across resists it."""
    pushed = TerminationMonitor(
        (), 100.0, look(), arm="arm", is_retreat=True, is_latched=lambda: False, is_cancelled=lambda: False
    )
    ends = []
    for tick in range(1, 6):
        seen = replace(
            look(),
            wrench=np.array([*force_n, 0.0, 0.0, 0.0]) * (tick > 1),
            commanded_tip_m=START.translation - [0.0, 0.0, 1e-4 * tick],
        )
        ends.append(pushed.ending(0.002 * tick, SAMPLE, seen))
    outcomes = {end.outcome for end in ends if end is not None}
    assert outcomes == ({expected} if expected else set())


@pytest.mark.parametrize(("cell_n", "transfer_n"), [(100.0, TRANSFER_FORCE_N), (20.0, 20.0)])
def test_a_transfer_touches_nothing_and_may_press_less_than_a_motion_into_contact(
    cell_n: float, transfer_n: float
) -> None:
    still = np.zeros((2, 6))
    transfer = JointTrajectory(name="t", times_s=np.array([0.0, 1.0]), positions_rad=still, velocities_rad_per_s=still)
    assert force_limit_n(transfer, cell_n) == transfer_n
    assert force_limit_n(Hold(name="h", duration_s=1.0), cell_n) == cell_n


def test_what_always_holds_says_how_much_it_was_and_names_an_arm_that_does_not_follow() -> None:
    pushed = watch()
    end = [pushed.ending(0.002 * tick, SAMPLE, look(104.2)) for tick in range(2)][-1]
    assert end is not None and end.device is None
    assert end.cause == "contact force 104 N; at most 100 N is allowed"
    behind = watch()
    end = [behind.ending(0.002 * tick, SAMPLE, look(behind_m=0.0312)) for tick in range(5)][-1]
    assert end is not None and end.device == "left_arm"
    assert end.cause == "left_arm does not follow: 31 mm away from its last set-point"


def test_an_arm_20_mm_behind_for_five_ticks_is_a_fault() -> None:
    assert endings(watch(), look(behind_m=0.0199), 20) == [None] * 20
    assert endings(watch(), look(behind_m=0.0201), 5) == [None] * 4 + [MotionOutcome.FAULT]


def test_a_force_counts_with_what_it_rises_by_while_an_arm_at_that_speed_stops() -> None:
    guard = Guard(name="limit", quantity=Quantity.FORCE, limit=100.0, ahead_s=0.012)

    def trips(force_n: float, speed_m_per_s: float) -> bool:
        watch = GuardSet((guard,), START.as_matrix())
        for k in range(5):
            tip_m = START.translation + np.array([0.0, 0.002 * k * speed_m_per_s, 0.0])
            now = measured(elapsed_s=0.002 * k, wrench=np.array([force_n, 0, 0, 0, 0, 0]), commanded_tip_m=tip_m)
            if watch.tripped(now):
                return True
        return False

    assert trips(91.0, 0.08)  # and 9.6 N
    assert not trips(90.0, 0.08)
    assert not trips(99.0, 0.0)
    assert not trips(30.0, 1.0)  # far from the limit a fast motion is no contact
