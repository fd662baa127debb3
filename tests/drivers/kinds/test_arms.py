"""Tests of the last check of set-points before the drives, and of a stop that comes while they are being enabled."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators import cia402, dynamixel, ur
from drivers.emulators.scripted import ScriptedArm
from drivers.kinds.arms import (
    BURST_PERIODS,
    BURST_S,
    RATE_MARGIN,
    KinematicsOptions,
    SetPointFilter,
    kinematics_of,
)
from hal.clock import Deadline, SimClock
from hal.errors import InvalidRequest, MotionRefused
from tests.drivers.rigs import soon, until, wired

HERE = np.zeros(6)


def make_filter(rate_hz: float = 100.0) -> SetPointFilter:
    options = KinematicsOptions.model_validate(kinematics_of(ScriptedArm().capabilities()), strict=False)
    return SetPointFilter("arm", options, command_rate_hz=rate_hz)


class Interrupting:
    """Joint speeds whose multiplication makes the link fail at that moment."""

    __array_ufunc__ = None  # numpy leaves the arithmetic to this class

    def __init__(self, speeds: Any, lose: threading.Thread) -> None:
        self._speeds, self._lose = speeds, lose

    def __mul__(self, other: float) -> Any:
        self._lose.start()
        self._lose.join(0.05)
        return self._speeds * other

    def __rtruediv__(self, other: Any) -> Any:
        return other / self._speeds


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


SPEED_RAD_PER_S = ScriptedArm().capabilities().velocity_rad_per_s[0]
ARRIVALS = st.lists(
    st.tuples(
        st.one_of(
            st.just(0.0), st.floats(0.0, 0.02), st.floats(0.0, 1.0)
        ),  # s since the set-point before: also bunches
        st.one_of(st.floats(-3.0, 3.0), st.sampled_from([-3.0, 3.0])),
    ),
    min_size=1,
    max_size=60,
)


@given(ARRIVALS, st.sampled_from([25.0, 100.0, 500.0]))
def test_in_every_window_the_joints_are_sent_no_further_than_their_budget(
    arrivals: list[tuple[float, float]], rate_hz: float
) -> None:
    filter_ = make_filter(rate_hz)
    filter_.begin(HERE, closings=0)
    now_s, at_s, travelled = 100.0, [], []
    before = 0.0
    for wait_s, wanted in arrivals:
        now_s += wait_s
        sent = float(filter_.passed(np.full(6, wanted), now_s)[0])
        at_s.append(now_s)
        travelled.append(abs(sent - before))
        before = sent
    burst_s = max(BURST_S, BURST_PERIODS / rate_hz)
    for first in range(len(at_s)):
        total = 0.0
        for last in range(first, len(at_s)):
            total += travelled[last]
            window_s = at_s[last] - at_s[first]
            assert total <= SPEED_RAD_PER_S * (burst_s + RATE_MARGIN * window_s) + 1e-9


@pytest.mark.parametrize("pause_s", [0.05, 0.1, 0.2, 5.0])
def test_a_pause_is_no_licence_to_jump(pause_s: float) -> None:
    filter_ = make_filter(100.0)
    filter_.begin(HERE, closings=0)
    filter_.passed(HERE, 1.0)
    sent = filter_.passed(np.full(6, 3.0), 1.0 + pause_s)
    assert np.all(sent <= 1.5 * SPEED_RAD_PER_S * min(pause_s, 0.1) + 1e-9)


def test_a_motion_at_the_speed_limit_passes_unchanged_when_its_set_points_come_in_bunches() -> None:
    filter_ = make_filter(125.0)
    filter_.begin(HERE, closings=0)
    filter_.passed(HERE, 0.0)
    for k in range(1, 100):
        wanted = np.full(6, 0.008 * k * SPEED_RAD_PER_S)
        arrived_s = 0.032 * math.ceil(k / 4)  # four at a time
        np.testing.assert_allclose(filter_.passed(wanted, arrived_s), wanted, atol=1e-12)


def test_a_joint_outside_its_limits_is_led_back_and_does_not_jump_back() -> None:
    filter_ = make_filter(100.0)
    outside = np.full(6, 3.4)
    filter_.begin(outside, closings=0)
    sent = filter_.passed(outside, 1.0)
    assert np.all(sent < outside) and np.all(outside - sent <= SPEED_RAD_PER_S * RATE_MARGIN * 0.01 + 1e-12)


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


@pytest.mark.parametrize(
    ("emulator", "driver", "options"),
    [(ur, "ur:rtde", {"watchdog_s": 2.0}), (cia402, "can:cia402", {}), (dynamixel, "serial:dynamixel", {})],
)
def test_no_arm_jumps_after_a_pause_between_set_points(emulator: Any, driver: str, options: dict[str, Any]) -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), driver, options) as device:
        device.enable(deadline=soon())
        here = device.command_position(arm.position_rad, deadline=soon())
        device.newest(soon(2.0), not_before_s=soon(0.2).at_s)
        sent = device.command_position(here + 1.0, deadline=soon())
        assert np.all(sent - here <= 1.5 * SPEED_RAD_PER_S * 0.1)
