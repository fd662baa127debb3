"""Watchdogs of emulated arms use the backing arm's clock, so a world that stops to render does not trip them."""

from typing import Any

import pytest

from drivers.emulators import cia402, dynamixel, ur
from drivers.emulators.base import time_of
from drivers.emulators.scripted import ScriptedArm
from tests.drivers.rigs import soon, until, wired

WATCHDOG_S = 0.1
ARMS = {
    "ur:rtde": (ur, {"watchdog_s": WATCHDOG_S}),
    "can:cia402": (cia402, {"heartbeat_s": WATCHDOG_S}),
    "serial:dynamixel": (dynamixel, {"watchdog_s": WATCHDOG_S}),
}


def fall_silent(device: Any) -> None:
    """Simulate a dead host: nothing more is sent."""
    device._next_beat_s = float("inf")
    if hasattr(device, "bus"):
        device.bus.close()


@pytest.mark.parametrize("driver", ARMS)
def test_a_dead_host_is_noticed_when_the_arms_own_time_has_passed_and_not_before(driver: str) -> None:
    emulator, options = ARMS[driver]
    arm = ScriptedArm(device_s=50.0)
    with wired(far_side := emulator.start(arm, {}), driver, options) as device:
        device.enable(deadline=soon())

        def has_moved() -> bool:
            device.command_position(arm.position_rad, deadline=soon())
            return arm.commands > 0

        until(has_moved)
        fall_silent(device)
        ticks = arm.reads
        until(lambda: arm.reads > ticks + 40)  # on the wall clock this takes far longer than the watchdog's time
        assert arm.is_enabled and arm.stops == 0
        arm.device_s = 50.0 + 2.0 * WATCHDOG_S
        until(lambda: not arm.is_enabled)
        assert far_side.address


def test_an_arm_without_a_clock_counts_by_the_wall() -> None:
    arm = ScriptedArm()
    first, second = (time_of(arm.read_state(deadline=soon())) for _ in range(2))
    assert 0.0 < first <= second
