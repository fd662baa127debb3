"""Tests of the last check of set-points before the drives, and of a stop that comes while they are being enabled."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.emulators import cia402, dynamixel, ur
from drivers.emulators.scripted import ScriptedArm
from drivers.kinds.arms import KinematicsOptions, SetPointFilter, kinematics_of
from hal.clock import Deadline, SimClock
from hal.errors import InvalidRequest, MotionRefused
from tests.drivers.rigs import soon, until, wired

HERE = np.zeros(6)


def make_filter() -> SetPointFilter:
    options = KinematicsOptions.model_validate(kinematics_of(ScriptedArm().capabilities()), strict=False)
    return SetPointFilter("arm", options, command_rate_hz=100.0)


class Interrupting:
    """Joint speeds whose multiplication makes the link fail at that moment."""

    def __init__(self, speeds: Any, lose: threading.Thread) -> None:
        self._speeds, self._lose = speeds, lose

    def __mul__(self, other: float) -> Any:
        self._lose.start()
        self._lose.join(0.05)
        return self._speeds * other


def test_a_link_that_is_lost_while_a_set_point_passes_leaves_the_drives_off() -> None:
    filter_ = make_filter()
    filter_.begin(HERE, closings=0)
    lose = threading.Thread(target=filter_.close)
    filter_._velocity = Interrupting(filter_._velocity, lose)  # the link is lost during the check
    np.testing.assert_allclose(filter_.passed(HERE, 1.0), HERE)
    lose.join()
    assert not filter_.is_open
    with pytest.raises(MotionRefused, match="off"):
        filter_.passed(HERE, 1.01)


def test_a_leap_is_cut_to_what_the_joints_can_do_and_nonsense_is_refused() -> None:
    filter_ = make_filter()
    filter_.begin(HERE, closings=0)
    sent = filter_.passed(np.full(6, 3.0), 1.0)
    assert np.all(sent > 0.0) and np.all(sent < 1.0)
    for wanted in (np.full(6, np.nan), np.zeros(5)):
        with pytest.raises(InvalidRequest, match="finite joint angles"):
            filter_.passed(wanted, 1.01)


class StoppingClock(SimClock):
    """Clock that calls `stop` when its time is read for the n-th time, i.e. at a known point of the caller's code."""

    def __init__(self, stop: Callable[[], None], *, at: int) -> None:
        super().__init__()
        self._stop, self._left = stop, at

    def now_s(self) -> float:
        self._left -= 1
        if self._left == 0:
            self._stop()
        return super().now_s()


@pytest.mark.parametrize(
    ("emulator", "driver", "at"),
    [
        *[(ur, "ur:rtde", at) for at in (1, 2, 3)],
        *[(cia402, "can:cia402", at) for at in (1, 2)],
        *[(dynamixel, "serial:dynamixel", at) for at in (1, 2)],
    ],
)
def test_a_stop_that_comes_while_the_drives_are_enabled_wins(emulator: Any, driver: str, at: int) -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), driver) as device:
        clock = StoppingClock(lambda: device.stop(deadline=soon()), at=at)
        with pytest.raises(MotionRefused, match="while the drives were being enabled"):
            device.enable(deadline=Deadline(2.0, clock))
        assert clock._left <= 0, "the stop came inside"
        with pytest.raises(MotionRefused, match="the drives are off"):
            device.command_position(arm.position_rad, deadline=soon())
        if emulator is not dynamixel:  # its torque stays on, so that the arm does not fall
            until(lambda: not arm.is_enabled)
        assert arm.commands == 0
        device.enable(deadline=soon())
        device.command_position(arm.position_rad, deadline=soon())
