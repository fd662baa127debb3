"""Tests of the Dynamixel arm: conformance, byte stuffing, fast sync read, watchdog, shutdown, faults."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.dynamixel import protocol
from drivers.dynamixel.arm import RAD_PER_COUNT
from drivers.emulators import dynamixel as emulator
from drivers.emulators.scripted import ScriptedArm
from hal.conformance import ArmContract, Rig
from hal.errors import CellError, DeviceFault, DeviceUnavailable, MotionRefused
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

DRIVER = "serial:dynamixel"


class TestDynamixel(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedArm(), {})
        with wired_rig(far_side, DRIVER, {"watchdog_s": 0.3}, sample_period_s=0.06) as rig:
            yield rig


@given(
    st.integers(0, 252), st.integers(1, 0x92), st.binary(max_size=60), st.lists(st.integers(min_value=0), max_size=6)
)
def test_packets_survive_stuffing_and_any_chunking(id_: int, inst: int, data: bytes, cuts: list[int]) -> None:
    data = data.replace(b"\x00\x00", protocol.STUFF)  # more headers inside than random data contain
    frame = protocol.encode(id_, inst, data)
    assert protocol.HEADER not in frame[4:]
    places = [0, *sorted(cut % (len(frame) + 1) for cut in cuts), len(frame)]
    framer = protocol.framer()
    found = [f for a, b in pairwise(places) for f in framer.feed(frame[a:b])]
    assert [protocol.decode(f) for f in found] == [protocol.Packet(id_, inst, data)]


@pytest.mark.parametrize("is_fast", [True, False])
@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status"])
def test_no_fault_of_the_bus_gives_wrong_joints(fault: str, is_fast: bool) -> None:
    arm = ScriptedArm()
    options = {"fault": fault, "every": 20, "seed": 8, "delay_s": 0.05, "silent_s": 0.05, "split_s": 0.01}
    with wired(emulator.start(arm, options), DRIVER, {"is_fast": is_fast}) as device:
        half_count = 0.5 * RAD_PER_COUNT + 1e-9
        assert count_good(device, lambda s: np.allclose(s.position_rad, arm.position_rad, atol=half_count)) >= 5


@pytest.mark.parametrize("fault", ["crc", "drop", "delay", "silent", "status", "disconnect"])
def test_it_connects_though_every_third_answer_is_bad(fault: str) -> None:
    arm = ScriptedArm()
    options = {"fault": fault, "every": 3, "delay_s": 0.15, "silent_s": 0.15, "away_s": 0.05}
    with wired(emulator.start(arm, options), DRIVER) as device:
        half_count = 0.5 * RAD_PER_COUNT + 1e-9
        assert count_good(device, lambda s: np.allclose(s.position_rad, arm.position_rad, atol=half_count)) >= 5


def test_a_mirrored_joint_with_its_own_zero_reads_and_goes_where_it_is_told() -> None:
    arm = ScriptedArm()
    options = {"directions": [1, -1, 1, 1, 1, 1], "zero_counts": [2048, 1000, 2048, 2048, 2048, 2048]}
    with wired(emulator.start(arm, {}), DRIVER, options) as device:
        raw = round(arm.position_rad[1] / RAD_PER_COUNT) + 2048
        measured = device.read_state(deadline=soon()).value.position_rad
        assert measured[1] == pytest.approx(-(raw - 1000) * RAD_PER_COUNT)
        device.enable(deadline=soon())
        device.command_position(measured, deadline=soon())
        until(lambda: arm.commands > 0)
        assert arm.position_rad[1] == pytest.approx((raw - 2048) * RAD_PER_COUNT)


def test_a_set_point_outlasts_a_busy_bus_and_only_the_newest_is_sent() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        here = device.read_state(deadline=soon()).value.position_rad
        commands = arm.commands
        with device.bus._lock:  # as while the bus waits for a servo
            for step in (0.01, 0.02):
                device.command_position(here + step, deadline=soon(0.02))
            assert arm.commands == commands
        until(lambda: arm.commands > commands)
        np.testing.assert_allclose(arm.position_rad, here + 0.02, atol=RAD_PER_COUNT)


def test_after_a_stop_no_pending_set_point_goes_out() -> None:
    arm = ScriptedArm()
    with wired(emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        here = device.read_state(deadline=soon()).value.position_rad
        with device.bus._lock:
            device.command_position(here + 0.02, deadline=soon(0.02))
            device._filter.close()
        device.newest(soon(), not_before_s=soon(0.0).at_s + 0.1)
        np.testing.assert_allclose(arm.position_rad, here, atol=RAD_PER_COUNT)


def test_enabling_sets_the_goal_to_where_the_arm_is_before_torque() -> None:
    arm = ScriptedArm()
    before = arm.position_rad.copy()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        far_side.servos[2].table[emulator.GOAL : emulator.GOAL + 4] = (100).to_bytes(4, "little")
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        assert abs(far_side.servos[2].goal - 2048 - before[1] / RAD_PER_COUNT) <= 0.5
        np.testing.assert_allclose(arm.position_rad, before, atol=RAD_PER_COUNT)


def test_the_servos_watchdogs_are_armed_and_stop_the_arm_of_a_dead_host() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, {"watchdog_s": 0.5}) as device:
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        assert far_side.servos[1].table[emulator.WATCHDOG] == 25
        device.bus.close()
        until(lambda: not arm.is_enabled)
        assert far_side.servos[1].table[emulator.WATCHDOG] == 0xFF


def test_a_tripped_watchdog_is_told_and_motion_is_off() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, {"watchdog_s": 0.5}) as device:
        device.enable(deadline=soon())
        far_side.servos[4].table[emulator.WATCHDOG] = 0xFF
        with pytest.raises(DeviceFault, match="watchdog of servo 4"):
            until(lambda: device.read_state(deadline=soon()) is None)
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_a_servo_that_started_again_in_motion_is_told_and_motion_is_off() -> None:
    """A restarted servo has no torque but still answers, so without the check the arm would move without it."""
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, {"watchdog_s": 0.5}) as device:
        device.enable(deadline=soon())
        far_side.servos[4] = emulator.Servo(4)
        with pytest.raises(DeviceFault, match="servo 4 has lost its torque"):
            until(lambda: device.read_state(deadline=soon()) is None)
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_servos_of_old_firmware_without_fast_reads_are_read_without() -> None:
    arm = ScriptedArm()
    far_side = emulator.start(arm, {})
    far_side.knows_fast_reads = False
    with wired(far_side, DRIVER) as device:
        device.enable(deadline=soon())
        np.testing.assert_allclose(
            device.read_state(deadline=soon()).value.position_rad, arm.position_rad, atol=RAD_PER_COUNT
        )


def test_servos_that_acknowledge_no_write_are_told_to() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    for servo in far_side.servos.values():
        servo.table[emulator.STATUS_RETURN] = 1
    with wired(far_side, DRIVER) as device:
        device.enable(deadline=soon())
        assert device.newest(soon(), not_before_s=soon(0.0).at_s).value.is_enabled


def test_a_servo_in_another_mode_is_told_with_the_remedy() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    far_side.servos[2].table[11] = 4
    try:
        with pytest.raises(DeviceUnavailable, match="servo 2 is in mode 4") as refused:
            connect(Context(name="arm"), DRIVER, far_side.address)
        assert "write 3 to its address 11" in refused.value.hint
    finally:
        far_side.close()


def test_an_overload_is_a_fault_that_enable_does_not_paper_over() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        device.enable(deadline=soon())
        far_side.overload(3)
        until(lambda: not arm.is_enabled)
        with pytest.raises(DeviceFault, match="servo 3 reports overload"):
            until(lambda: device.read_state(deadline=soon()) is None)
        with pytest.raises(CellError, match="servo 3"):
            device.enable(deadline=soon())


def test_torque_stays_off_after_unplugging() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER) as device:
        far_side.unplug(away_s=0.05)
        until(lambda: device.health().reconnects >= 1 and device.mailbox.error() is None)
        assert not far_side.servos[1].table[emulator.TORQUE]
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


def test_a_missing_servo_is_told() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    try:
        with pytest.raises(DeviceUnavailable, match="servo 9 does not answer"):
            connect(Context(name="arm"), DRIVER, {**far_side.address, "ids": [1, 2, 3, 4, 5, 9]})
    finally:
        far_side.close()


def test_eeprom_is_locked_under_torque() -> None:
    servo = emulator.Servo(1)
    assert servo.write(emulator.TORQUE, b"\x01") == 0
    assert servo.write(11, b"\x01") == emulator.ACCESS
