"""Tests of the last part of a lever's stroke: an end stop is distinguished from stick-slip of the bar."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.motion import STOPPING_S, Guard, MotionReport
from manipulation.skills.attempt import Attempt
from manipulation.skills.lever import (
    EASY_N,
    FIRM_N,
    LARGEST_N,
    LAST_M_PER_S,
    STOP_TRIES,
    STROKE_M_PER_S,
    _Arc,
    _to_the_stop,
    _turn_most,
    speed_for,
)

SPAN_RAD = np.pi / 2
AXIS = np.array([0.0, 0.0, -1.0])
RADIUS_M = 0.1
PUSH = np.array([25.0, 0.0, 0.0, 0.0, 0.0, 0.0])
LAG_DEG = float(np.degrees(25.0 / 5000.0 / RADIUS_M))  # the bar lags behind the tool by this angle
START = RigidTransform.from_components([0.1, 0.0, 0.0], Rotation.identity())
AGAINST = (1.0, 0.0, 0.0)
WAY = _Arc(hub=np.zeros(3), axis=AXIS, radius_m=RADIUS_M, span_rad=SPAN_RAD, against=AGAINST)


class Turned:
    """Attempt that moves the tool to a sequence of angles; each motion ends by the guard named with it."""

    def __init__(self, ends: list[tuple[float, str | None]]) -> None:
        self.ends = ends
        self.angles_rad = [np.radians(81.0)]
        self.goals_rad: list[float] = []
        self.context = SimpleNamespace(hand=SimpleNamespace(pad_stiffness_n_per_m=5000.0))

    def pose(self) -> RigidTransform:
        turn = Rotation.from_rotvec(self.angles_rad[-1] * AXIS)
        return RigidTransform.from_components(turn.apply(START.translation), turn)

    def along(self, poses: list[RigidTransform], **_: Any) -> MotionReport:
        self.goals_rad.append(float((poses[-1].rotation * START.rotation.inv()).magnitude()))
        degrees, tripped = self.ends[len(self.goals_rad) - 1]
        self.angles_rad.append(np.radians(degrees))
        return cast(MotionReport, SimpleNamespace(tripped=tripped, base_from_tool=self.pose(), wrench=PUSH))


def carried(ends: list[tuple[float, str | None]]) -> tuple[Turned, float]:
    attempt = Turned(ends)
    return attempt, _to_the_stop(cast(Attempt, attempt), WAY, START, LAST_M_PER_S)


@pytest.mark.parametrize("end", [(91.0, "end stop"), (89.5, "end stop"), (102.0, None), (83.0, "effort")])
def test_an_end_stop_a_free_way_and_too_much_effort_end_it_at_once(end: tuple[float, str | None]) -> None:
    attempt, turned_rad = carried([end])
    assert len(attempt.goals_rad) == 1
    assert np.degrees(turned_rad) == pytest.approx(end[0] - LAG_DEG)


def test_a_rise_long_before_the_state_is_passed_on_the_way_to_the_same_goal() -> None:
    attempt, turned_rad = carried([(82.0, "end stop"), (88.5, "end stop"), (94.0, "end stop")])
    assert np.degrees(turned_rad) == pytest.approx(94.0 - LAG_DEG)
    assert attempt.goals_rad == pytest.approx([attempt.goals_rad[0]] * 3)


def test_a_bar_that_is_stuck_is_not_pushed_for_ever() -> None:
    attempt, _ = carried([(82.0, "end stop")] * 10)
    assert len(attempt.goals_rad) == STOP_TRIES


@pytest.mark.parametrize(("felt_n", "limit_n"), [(40.0, 62.0), (59.2, 86.0), (80.0, 86.0)])
def test_a_heavy_bar_is_pushed_hardly_more_than_it_was_felt_to_need(felt_n: float, limit_n: float) -> None:
    limits_n: list[float] = []
    push = felt_n * np.array([[*AGAINST, 0.0, 0.0, 0.0]])

    def along(_poses: list[RigidTransform], *, guards: tuple[Guard, ...], **_: Any) -> MotionReport:
        limits_n.append(next(guard.limit for guard in guards if guard.axis == AGAINST))
        tripped = "effort" if limits_n[-1] < felt_n else None
        log = SimpleNamespace(wrench=np.repeat(push, 20, axis=0))
        return cast(MotionReport, SimpleNamespace(tripped=tripped, base_from_tool=START, wrench=push[0], log=log))

    hand = SimpleNamespace(pad_stiffness_n_per_m=5000.0)
    attempt = SimpleNamespace(pose=lambda: START, along=along, context=SimpleNamespace(hand=hand))
    assert _turn_most(cast(Attempt, attempt), WAY, START, 1.4) == pytest.approx(felt_n)
    loads_n = [EASY_N, FIRM_N, *([LARGEST_N] if felt_n > FIRM_N else [])]
    assert limits_n == [*loads_n, pytest.approx(min(limit_n, LARGEST_N))]


@pytest.mark.parametrize("felt_n", [20.0, 50.0, 65.0, 80.0, LARGEST_N])
def test_the_heavier_a_bar_the_slower_it_is_turned(felt_n: float) -> None:
    """At 80 mm/s a bar of 81 N was pressed with 113 N before the arm had stopped."""
    pads_n_per_m, friction_n = 10_000.0, 5.0
    assert felt_n + pads_n_per_m * STOPPING_S * speed_for(felt_n) + friction_n < 100.0
    assert (speed_for(felt_n) == STROKE_M_PER_S) == (felt_n == 20.0)
