"""Tests of the FT 300, streaming and as Modbus slave: conformance, values, faults, independent decoding."""

import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusSerialClient

from drivers.emulators import ft300 as emulator
from drivers.emulators.scripted import ScriptedForceTorque, scripted_wrench
from drivers.ft300 import stream_framer, wrench
from hal.conformance import ForceTorqueContract, Rig
from hal.devices import Wrench
from hal.errors import DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, wired, wired_rig

DRIVERS = ("serial:ft300", "modbus:ft300")


@pytest.fixture(params=DRIVERS)
def driver(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class TestFt300(ForceTorqueContract):
    @pytest.fixture
    def rig(self, driver: str) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedForceTorque(), {})
        with wired_rig(far_side, driver, sample_period_s=0.1) as rig:
            yield rig


def is_a_true_wrench(value: Wrench, reads: int) -> bool:
    """Return whether all six components are of the same one of the scripted device's latest readings."""
    index = round(value.force_n[0] / 0.01)
    true = scripted_wrench(index)
    return (
        reads - 60 <= index <= reads
        and np.allclose(value.force_n, true.force_n, atol=0.0051)
        and np.allclose(value.torque_nm, true.torque_nm, atol=0.00051)
    )


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status"])
def test_no_fault_of_the_wire_gives_a_wrong_or_mixed_wrench(fault: str, driver: str) -> None:
    backing = ScriptedForceTorque()
    options = {"fault": fault, "every": 4, "seed": 1, "delay_s": 0.15, "silent_s": 0.1}
    with wired(emulator.start(backing, options), driver) as device:
        assert count_good(device, lambda value: is_a_true_wrench(value, backing.reads)) >= 5


def test_a_stream_left_on_is_stopped_before_it_is_set_up() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {})
    far_side.table.is_streaming = True
    with wired(far_side, "serial:ft300") as device:
        assert device.read_wrench(deadline=soon()).quality is Quality.VALID


def test_beyond_the_range_is_saturated(driver: str) -> None:
    class Overloaded(ScriptedForceTorque):
        def read_wrench(self, *, deadline: Any) -> Stamped[Wrench]:
            sample = super().read_wrench(deadline=deadline)
            return replace(sample, value=Wrench(force_n=np.array([320.0, 0, 0]), torque_nm=np.zeros(3)))

    with wired(emulator.start(Overloaded(), {}), driver) as device:
        sample = device.read_wrench(deadline=soon())
    assert (sample.quality, sample.cause) == (Quality.INVALID, Cause.SATURATED)


def test_a_wrong_unit_gives_no_data_and_says_so() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {})
    try:
        with pytest.raises((DeviceUnavailable, DeviceTimeout), match="no answer"):
            connect(Context(name="wrist"), "modbus:ft300", {**far_side.address, "unit": 7})
    finally:
        far_side.close()


@given(st.lists(st.integers(-32768, 32767), min_size=6, max_size=6))
def test_frames_decode_to_what_was_encoded(values: list[int]) -> None:
    (frame,) = stream_framer().feed(emulator.stream_frame(values))
    decoded = wrench(struct.unpack("<6h", frame[2:14]))
    np.testing.assert_allclose(decoded.force_n * 100, values[:3], atol=1e-9)
    np.testing.assert_allclose(decoded.torque_nm * 1000, values[3:], atol=1e-9)


@pytest.mark.third_party("pymodbus", "modbus:ft300")
def test_pymodbus_reads_the_emulators_registers() -> None:
    backing = ScriptedForceTorque()
    far_side = emulator.start(backing, {})
    client = ModbusSerialClient(far_side.address["port"], baudrate=19_200, timeout=1, retries=0)
    try:
        assert client.connect()
        words = client.read_holding_registers(180, count=6, device_id=9).registers
        signed = [word - 65_536 if word >= 32_768 else word for word in words]
        true = scripted_wrench(backing.reads)
        np.testing.assert_allclose(np.array(signed[:3]) / 100, true.force_n, atol=0.0051)
        np.testing.assert_allclose(np.array(signed[3:]) / 1000, true.torque_nm, atol=0.00051)
    finally:
        client.close()
        far_side.close()
