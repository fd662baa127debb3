"""Tests of the arm's drives under the control thread: timing of set-points, and a stop that always succeeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hal.clock import SimClock, WallClock
from hal.errors import DeviceTimeout
from manipulation.control.drives import Drives
from manipulation.control.sensing import DeviceFailure

DT_S = 0.002


class Wall(WallClock):
    """Fake wall clock; a sleep takes `late_s` longer than requested."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.late_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += max(0.0, duration_s) + self.late_s


class ArmOf:
    """Arm that records its calls and fails as configured."""

    name = "arm"

    def __init__(self, fault: Exception | None = None) -> None:
        self.fault = fault
        self.asked: list[str] = []

    def _ask(self, what: str) -> None:
        self.asked.append(what)
        if self.fault is not None:
            raise self.fault

    def enable(self, *, deadline: Any) -> None:
        assert not deadline.is_past()
        self._ask("enable")

    def stop(self, *, deadline: Any) -> None:
        assert not deadline.is_past()
        self._ask("stop")

    def command_position(self, position_rad: np.ndarray, *, deadline: Any) -> np.ndarray:
        assert not deadline.is_past()
        self._ask("command")
        return position_rad / 2.0


def drives_of(arm: ArmOf, clock: Any = None) -> Drives:
    return Drives(arm, clock or SimClock(), DT_S)


def test_on_the_wall_the_rhythm_is_even_although_a_tick_takes_time() -> None:
    wall = Wall()
    drives = drives_of(ArmOf(), wall)
    drives.begin_rhythm()
    ends = []
    for worked_s in (0.0005, 0.0015, 0.0, 0.001):
        wall.time_s += worked_s
        drives.pass_tick()
        ends.append(wall.time_s - 100.0)
    np.testing.assert_allclose(ends, DT_S * np.arange(1, 5), atol=1e-9)


def test_after_a_late_tick_the_rhythm_starts_anew_and_nothing_is_caught_up() -> None:
    wall = Wall()
    drives = drives_of(ArmOf(), wall)
    drives.begin_rhythm()
    wall.time_s += 0.050
    drives.pass_tick()
    assert wall.time_s == pytest.approx(100.050), "late: no wait"
    for k in range(1, 4):
        drives.pass_tick()
        assert wall.time_s == pytest.approx(100.050 + k * DT_S)


def test_a_rhythm_begun_after_a_pause_does_not_hurry() -> None:
    wall = Wall()
    drives = drives_of(ArmOf(), wall)
    wall.time_s += 10.0
    drives.begin_rhythm()
    drives.pass_tick()
    assert wall.time_s == pytest.approx(110.0 + DT_S)


def test_a_simulated_world_makes_one_period_whatever_the_tick_took() -> None:
    clock = SimClock()
    drives = drives_of(ArmOf(), clock)
    for k in range(1, 4):
        drives.pass_tick()
        assert clock.now_s() == pytest.approx(k * DT_S)


def test_drives_are_switched_off_once_and_only_when_they_are_on() -> None:
    arm = ArmOf()
    drives = drives_of(arm)
    drives.switch_off()
    assert arm.asked == []
    drives.switch_on()
    assert drives.are_on
    drives.switch_off()
    drives.switch_off()
    assert not drives.are_on
    assert arm.asked == ["enable", "stop"]


def test_what_the_arm_took_is_returned() -> None:
    np.testing.assert_array_equal(drives_of(ArmOf()).send(np.full(6, 0.4)), np.full(6, 0.2))


@pytest.mark.parametrize("fault", [DeviceTimeout("arm silent", hint="cable", device="arm"), ValueError("a defect")])
def test_an_arm_that_fails_is_a_failure_of_the_device_and_no_reason_not_to_go_off(fault: Exception) -> None:
    arm = ArmOf(fault)
    drives = drives_of(arm)
    with pytest.raises(DeviceFailure) as caught:
        drives.switch_on()
    assert caught.value.device == "arm" and not drives.are_on
    with pytest.raises(DeviceFailure):
        drives.send(np.zeros(6))
    drives.stop()
    drives.are_on = True
    drives.switch_off()
    assert not drives.are_on
    assert arm.asked == ["enable", "command", "stop", "stop"]
