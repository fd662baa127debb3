"""Tests of a Dynamixel gripper: conformance, faults of the link, grip by current, no torque unless commanded."""

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.emulators import dynamixel_gripper as emulator
from drivers.emulators.dynamixel import HARDWARE_ERROR, OVERLOAD, TORQUE, WATCHDOG
from drivers.emulators.scripted import ScriptedGripper, ScriptedLights
from hal.conformance import GripperContract, Rig
from hal.errors import DeviceFault, InvalidRequest, Unsupported
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

DRIVER = "serial:dynamixel_gripper"


class TestDynamixelGripper(GripperContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedGripper(), {}), DRIVER, sample_period_s=0.05) as rig:
            yield rig


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "garbage", "echo"])
def test_no_fault_of_the_wire_gives_a_wrong_width(fault: str) -> None:
    gripper = ScriptedGripper(object_m=0.04)
    far_side = emulator.start(gripper, {"fault": fault, "every": 7, "delay_s": 0.1})
    with wired(far_side, DRIVER) as device:
        width_m = gripper.read_state(deadline=soon()).value.width_m
        assert count_good(device, lambda value: abs(value.width_m - width_m) < 1e-4) >= 5


def test_a_thing_between_the_jaws_is_held_with_the_force_that_was_asked_for() -> None:
    with wired(emulator.start(ScriptedGripper(object_m=0.04), {}), DRIVER) as device:
        device.command(width_m=0.0, force_n=30.0, speed_m_per_s=0.1, deadline=soon())
        until(lambda: device.read_state(deadline=soon()).value.is_holding)
        state = device.read_state(deadline=soon()).value
    assert state.force_n == pytest.approx(30.0, rel=0.02)
    assert state.width_m == pytest.approx(0.04, abs=1e-3)


def test_torque_that_was_lost_does_not_come_back_by_itself() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER) as device:
        assert far_side.servo.table[TORQUE] == 1
        far_side.servo.table[TORQUE] = 0
        far_side.unplug(away_s=0.05)
        until(lambda: device.health().connected and device.mailbox.error() is None)
        with pytest.raises(DeviceFault, match=r"servo torque of .* is off"):
            device.command(width_m=0.01, force_n=30.0, speed_m_per_s=0.1, deadline=soon())
        assert far_side.servo.table[TORQUE] == 0


def test_a_command_arms_the_watchdog_and_clears_a_tripped_one() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER, {"watchdog_s": 0.5}) as device:
        far_side.servo.table[WATCHDOG] = 0xFF
        device.command(width_m=0.03, force_n=30.0, speed_m_per_s=0.1, deadline=soon())
        assert far_side.servo.table[WATCHDOG] == 25


def test_a_servo_in_another_mode_under_torque_is_refused() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    far_side.servo.table[TORQUE] = 1
    try:
        with pytest.raises(Exception, match="mode 3"):
            connect(Context(name="gripper"), DRIVER, far_side.address)
    finally:
        far_side.close()


def test_a_command_to_an_overloaded_servo_names_the_cause() -> None:
    with wired(far_side := emulator.start(ScriptedGripper(), {}), DRIVER) as device:
        far_side.servo.table[HARDWARE_ERROR] = OVERLOAD
        with pytest.raises(DeviceFault, match="servo 7 reports overload") as fault:
            device.command(width_m=0.02, force_n=10.0, speed_m_per_s=0.1, deadline=soon())
        assert "only a reboot clears this error" in fault.value.hint


def test_numbers_that_are_none_and_other_devices_are_refused() -> None:
    with wired(emulator.start(ScriptedGripper(), {}), DRIVER) as device, pytest.raises(InvalidRequest):
        device.command(width_m=float("nan"), force_n=1.0, speed_m_per_s=0.1, deadline=soon())
    with pytest.raises(Unsupported, match="lights"):
        emulator.start(ScriptedLights(), {})
