"""Tests of a guarded move on a jerky arm: a force that is gone at rest was the inertia of the hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.motion import DeclaredMotion, Hold, MotionLog, MotionOutcome, MotionReport
from manipulation.arm.kinematics import Kinematics
from manipulation.planning.cartesian_path import shifted
from manipulation.skills.attempt import Attempt
from manipulation.skills.contact import force_at_rest_n, meet
from tests.manipulation.arms import T3
from tests.manipulation.skills.test_contact import AT_HOME, ScriptedMover, context, report

LENGTH_M = 0.022
GIVE_N_PER_M = 5000.0


class JerkyMover(ScriptedMover):
    """Mover that stops at given depths with 5 N; at rest the force becomes that of `rest_n`.

    Args:
        stops_m: depths at which the guard trips, one per try; after them the move is completed.
        rest_n: force at rest after each stop.
    """

    def __init__(self, stops_m: list[float], rest_n: list[float]) -> None:
        super().__init__(report(MotionOutcome.COMPLETED))
        self._stops, self._rest_n, self._tries = stops_m, rest_n, 0

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        self.asked.append(motion.name)
        if isinstance(motion, Hold):
            return self._report(
                np.full(20, LENGTH_M), np.r_[np.full(10, 7.0), np.full(10, self._rest_n[self._tries - 1])]
            )
        self._tries += 1
        if self._tries > len(self._stops):
            return self._report(np.array([0.0, LENGTH_M]), np.zeros(2))
        depth = self._stops[self._tries - 1] + np.linspace(-0.002, 0.001, 31)
        force = GIVE_N_PER_M * np.clip(depth - self._stops[self._tries - 1], 0.0, None)
        return self._report(depth, force, tripped="contact")

    def _report(self, depth_m: np.ndarray, force_n: np.ndarray, tripped: str | None = None) -> MotionReport:
        n = len(depth_m)
        along = AT_HOME.rotation.apply([1.0, 0.0, 0.0])
        wrench = np.zeros((n, 6))
        wrench[:, 0] = -force_n
        log = MotionLog(
            times_s=0.002 * np.arange(n), positions_rad=np.zeros((n, 6)), wrench=wrench,
            tip_m=AT_HOME.translation + depth_m[:, None] * along,
        )  # fmt: skip
        outcome = MotionOutcome.COMPLETED if tripped is None else MotionOutcome.GUARD
        there = shifted(AT_HOME, (float(depth_m[-1]), 0.0, 0.0))
        return replace(self.answer, outcome=outcome, tripped=tripped, base_from_tool=there, log=log)


def attempt_with(mover: JerkyMover, *, resolution_rad: float) -> Attempt:
    arm = Kinematics.of(replace(T3, resolution_rad=resolution_rad))
    return Attempt(replace(context(mover.answer), mover=mover, kinematics=arm))


def feel(mover: JerkyMover, *, resolution_rad: float = 1.5e-3):
    goal = shifted(AT_HOME, (LENGTH_M, 0.0, 0.0))
    attempt = attempt_with(mover, resolution_rad=resolution_rad)
    return meet(attempt, goal, name="feel", speed_m_per_s=0.02, stop_n=1.3)


def test_the_move_goes_on_until_a_force_stays_at_rest() -> None:
    mover = JerkyMover([0.001, 0.004, 0.009], [0.1, -0.2, 3.0])
    met = feel(mover)
    assert met.is_met
    assert mover.asked == ["feel", "feel at rest"] * 3
    assert met.way_m == pytest.approx(0.009, abs=1e-4)
    assert met.give_n_per_m == pytest.approx(GIVE_N_PER_M, rel=0.05)


def test_a_hand_that_only_shook_met_nothing() -> None:
    mover = JerkyMover([0.001, 0.004], [0.1, 0.2])
    assert not feel(mover).is_met
    assert mover.asked[-1] == "feel"


def test_a_first_firm_contact_costs_one_look_at_rest() -> None:
    mover = JerkyMover([0.009], [1.0])
    assert feel(mover).is_met
    assert mover.asked == ["feel", "feel at rest"]


def test_a_smooth_arm_believes_its_first_force() -> None:
    """A light slider that was hit leaves no force at rest."""
    mover = JerkyMover([0.004, 0.009], [0.0, 3.0])
    assert feel(mover, resolution_rad=1e-6).way_m == pytest.approx(0.004, abs=1e-4)
    assert mover.asked == ["feel"]


def test_what_gives_way_at_once_is_met_when_the_hand_gets_no_further() -> None:
    mover = JerkyMover([0.009] * 100, [0.0] * 100)
    assert feel(mover).is_met
    assert len(mover.asked) < 100


def test_the_force_at_rest_is_that_of_the_second_half() -> None:
    mover = JerkyMover([0.009], [2.0])
    attempt = attempt_with(mover, resolution_rad=1.5e-3)
    feel(mover)
    assert force_at_rest_n(attempt, np.array([-1.0, 0.0, 0.0])) == pytest.approx(2.0)
