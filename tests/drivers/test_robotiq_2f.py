"""Tests of the Robotiq 2F: conformance, activation, grip, faults of gripper and link, frames of the manual."""

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.emulators import robotiq_2f as emulator
from drivers.emulators.scripted import ScriptedGripper
from drivers.robotiq_2f import decode_status, encode_command
from hal.conformance import GripperContract, Rig
from hal.errors import CellError, DeviceFault, InvalidRequest
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from tests.drivers.rigs import soon, until, wired, wired_rig

DRIVER = "modbus:robotiq_2f"


class TestRobotiq2F(GripperContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedGripper(), {}), DRIVER, sample_period_s=0.1) as rig:
            yield rig


def test_commands_and_status_are_the_manuals() -> None:
    assert encode_command(action=9, position=255, speed=255, force=255) == (0x0900, 0x00FF, 0xFFFF)
    status = decode_status((0x3900, 0x00FF, 0x0E0A))
    assert (status.is_activated, status.goes_to, status.state, status.object) == (True, True, 3, 0)
    assert (status.fault, status.echo, status.position, status.current_ma) == (0, 255, 14, 100)


def test_it_grips_and_holds() -> None:
    with wired(emulator.start(ScriptedGripper(object_m=0.02), {}), DRIVER) as device:
        device.command(width_m=0.0, force_n=50.0, speed_m_per_s=0.15, deadline=soon())
        until(lambda: device.read_state(deadline=soon()).value.is_holding)
        state = device.read_state(deadline=soon()).value
    assert state.width_m == pytest.approx(0.02, abs=4e-4)
    assert state.force_n == pytest.approx(50.0, abs=1.0)
    assert not state.is_moving


def test_the_old_moves_result_is_not_taken_for_the_new_ones() -> None:
    """The gripper counts as moving until it echoes the new position."""
    far_side = emulator.start(ScriptedGripper(object_m=0.02), {})
    with wired(far_side, DRIVER) as device:
        device.command(width_m=0.0, force_n=50.0, speed_m_per_s=0.15, deadline=soon())
        until(lambda: device.read_state(deadline=soon()).value.is_holding)
        device._goal = 77  # a goal that the gripper does not echo
        state = device.newest(soon(), not_before_s=soon(0.0).at_s + 0.02).value
    assert state.is_moving and not state.is_holding


def test_the_width_that_was_really_commanded_is_told() -> None:
    with wired(emulator.start(ScriptedGripper(), {}), DRIVER) as device:
        sent_m = device.command(width_m=0.0401, force_n=1.0, speed_m_per_s=9.0, deadline=soon())
        assert sent_m == pytest.approx(0.0401, abs=0.085 / 227 / 2 + 1e-9)
        with pytest.raises(InvalidRequest):
            device.command(width_m=float("nan"), force_n=1.0, speed_m_per_s=0.1, deadline=soon())


@pytest.mark.parametrize(("code", "text"), [(8, "hot"), (0xA, "supply"), (0xE, "current")])
def test_the_grippers_faults_are_named(code: int, text: str) -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER) as device:
        device.read_state(deadline=soon())
        far_side.table.fault = code
        with pytest.raises(DeviceFault, match=text) as caught:
            device.newest(soon(), not_before_s=soon(0.0).at_s + 0.05)
        assert caught.value.details["code"] == code
        far_side.table.fault = 0
        assert device.newest(soon(), not_before_s=soon(0.0).at_s)


@pytest.mark.parametrize("code", [7, 9])
def test_a_gripper_that_complains_of_no_activation_or_no_host_is_connected_and_its_readings_are_not_valid(
    code: int,
) -> None:
    far_side = emulator.start(ScriptedGripper(), {"fault_code": code})
    with wired(far_side, DRIVER) as device:
        assert device.read_state(deadline=soon()).quality is Quality.INVALID
        far_side.table.fault = 0
        assert device.newest(soon(), not_before_s=soon(0.0).at_s + 0.05).quality is Quality.VALID


def test_a_gripper_that_has_started_anew_knows_no_width() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER) as device:
        assert device.read_state(deadline=soon()).quality is Quality.VALID
        far_side.table.write_registers(1000, [0])  # its value after a power cycle
        sample = device.newest(soon(), not_before_s=soon(0.0).at_s + 0.05)
        assert (sample.quality, sample.cause) == (Quality.INVALID, Cause.DEVICE)


def test_a_lost_activation_is_said_and_nothing_moves_by_itself() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER) as device:
        far_side.table.write_registers(1000, [0])
        far_side.unplug(away_s=0.05)
        until(lambda: device.health().connected)
        assert far_side.table.output[0] == 0
        with pytest.raises(DeviceFault, match="not activated"):
            device.command(width_m=0.01, force_n=30.0, speed_m_per_s=0.1, deadline=soon())


def test_without_activation_nothing_is_written() -> None:
    far_side = emulator.start(ScriptedGripper(), {})
    with wired(far_side, DRIVER, {"activate": False}):
        assert far_side.table.output == [0, 0, 0]


def test_a_gripper_that_never_gets_ready_is_closed_again() -> None:
    far_side = emulator.start(ScriptedGripper(), {"activation_s": 10.0})
    try:
        with pytest.raises(DeviceFault, match="not activated"):
            connect(Context(name="hand"), DRIVER, {**far_side.address, "activation_s": 0.1})
    finally:
        far_side.close()


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "garbage", "echo"])
def test_no_fault_of_the_wire_gives_a_wrong_width(fault: str) -> None:
    options = {"fault": fault, "every": 4, "delay_s": 0.15}
    with wired(emulator.start(ScriptedGripper(object_m=0.03), options), DRIVER) as device:
        for _ in range(8):
            try:
                device.command(width_m=0.03, force_n=30.0, speed_m_per_s=0.15, deadline=soon())
                width_m = device.newest(soon(0.4), not_before_s=soon(0.0).at_s).value.width_m
            except CellError:
                continue
            assert 0.03 - 4e-4 <= width_m <= 0.04 + 4e-4
