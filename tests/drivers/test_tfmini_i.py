"""Tests of the TFmini-i: conformance over Modbus RTU and CAN, faults of both links, and third-party clients."""

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any

import can
import pytest
from pymodbus.client import ModbusSerialClient

from drivers.emulators import tfmini_i as emulator
from drivers.emulators.scripted import ScriptedLights, ScriptedProximity
from drivers.tfmini_i import CanTfmini, CanTfminiOptions, ModbusTfmini, ModbusTfminiOptions, SensorClock
from drivers.transport.can_frames import CanFrame, record
from hal.conformance import ProximityContract, Rig
from hal.errors import Unsupported
from hal.readings import Cause, Quality
from hal.registry import Context
from tests.drivers.rigs import count_good, soon, wired, wired_rig

WIRES = {"modbus:tfmini": emulator.start_modbus, "can:tfmini": emulator.start_can}


class TestOverModbus(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start_modbus(ScriptedProximity(), {}), "modbus:tfmini", sample_period_s=0.05) as rig:
            yield rig


class TestOverCan(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start_can(ScriptedProximity(), {}), "can:tfmini", sample_period_s=0.05) as rig:
            yield rig


class TestOverAVirtualCanBus(ProximityContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start_can(ScriptedProximity(), {"transport": "virtual"})
        with wired_rig(far_side, "can:tfmini", sample_period_s=0.05) as rig:
            yield rig


@pytest.mark.parametrize("driver", WIRES)
@pytest.mark.parametrize("fault", ["drop", "dup", "split", "delay", "garbage", "echo"])
def test_no_fault_of_the_wire_gives_a_wrong_distance(driver: str, fault: str) -> None:
    options = {"fault": fault, "every": 3, "delay_s": 0.15}
    far_side = WIRES[driver](ScriptedProximity(fixed_m=0.57), options)
    with wired(far_side, driver) as device:
        assert count_good(device, lambda value: bool(value == pytest.approx(0.57))) >= 5


@pytest.mark.parametrize("driver", WIRES)
def test_the_sensors_clock_is_given_out_and_its_wrap_is_no_step(driver: str) -> None:
    far_side = WIRES[driver](ScriptedProximity(), {"clock_start_ms": (1 << 32) - 200})
    with wired(far_side, driver) as device:
        first = device.newest(soon())
        later = device.newest(soon(), not_before_s=first.host_time_s + 0.4)
        passed_s = later.device_time_s - first.device_time_s
        assert passed_s == pytest.approx(later.host_time_s - first.host_time_s, abs=0.05)


def test_a_measurement_that_was_read_before_is_no_new_sample() -> None:
    with wired(emulator.start_modbus(ScriptedProximity(), {"rate_hz": 10}), "modbus:tfmini") as device:
        first = device.newest(soon())
        with pytest.raises(Exception, match="silent"):
            device.newest(soon(0.02), not_before_s=first.host_time_s + 10.0)
    clock = SensorClock()
    assert [clock.is_new(stamp) for stamp in (5, 5, 6)] == [True, False, True]


@pytest.mark.parametrize("after_s", [0.0, 0.003, 0.006, 0.009])
def test_a_stamp_is_right_however_long_after_a_measurement_the_first_poll_comes(after_s: float) -> None:
    options = ModbusTfminiOptions(port="/dev/null", baud=115_200)
    device, clock = ModbusTfmini(Context(name="finger"), options), SensorClock()
    worst_s, period_s = 0.0, 1.0 / options.rate_hz
    for poll in range(200):
        asked_s = 100.0 + after_s + poll * device.period_s
        measured_s = math.floor(asked_s / period_s) * period_s
        _, stamp_s = clock.times_s(round((measured_s - 99.0) * 1000.0), asked_s)
        if poll >= 100:
            worst_s = max(worst_s, abs(stamp_s - measured_s))
    device.close()
    assert worst_s < 0.001


@pytest.mark.parametrize("order", ["little", "big"])
def test_frames_of_the_tf03_repeated_of_other_nodes_and_of_other_lengths(order: Any) -> None:
    device = CanTfmini(Context(name="finger"), CanTfminiOptions(channel="/dev/null", byte_order=order))
    mark = "<" if order == "little" else ">"
    reading = struct.pack(mark + "HHH", 123, 500, 0)
    for id_, data in ((3, reading), (3, reading), (4, bytes(8)), (3, bytes(5))):
        device.receive(record(CanFrame(id_, data)), 1.0)
    samples, _ = device.mailbox.since(0)
    assert [sample.value for sample in samples] == [pytest.approx(1.23)], "one that came twice is one"
    assert samples[0].device_time_s is None
    assert device.health().errors == 1


def test_a_weak_echo_is_invalid() -> None:
    with wired(emulator.start_can(ScriptedProximity(fixed_m=float("nan")), {}), "can:tfmini") as device:
        sample = device.read_distance_m(deadline=soon())
    assert (sample.quality, sample.cause) == (Quality.INVALID, Cause.OUT_OF_RANGE)


@pytest.mark.third_party("pymodbus", "modbus:tfmini")
def test_pymodbus_reads_the_registers() -> None:
    far_side = emulator.start_modbus(ScriptedProximity(fixed_m=0.5), {})
    client: Any = ModbusSerialClient(far_side.address["port"], baudrate=115_200, timeout=2)
    try:
        assert client.connect()
        words = client.read_holding_registers(0, count=5, device_id=1).registers
        assert words[:2] == [50, emulator.STRONG]
        assert client.read_holding_registers(0, count=50, device_id=1).isError()
    finally:
        client.close()
        far_side.close()


@pytest.mark.third_party("python-can", "can:tfmini")
def test_python_can_hears_the_frames() -> None:
    far_side = emulator.start_can(ScriptedProximity(fixed_m=0.5), {})
    try:
        with can.Bus(interface="slcan", channel=far_side.address["channel"], bitrate=250_000) as bus:
            message = bus.recv(timeout=3.0)
        assert message is not None and message.arbitration_id == 3
        assert struct.unpack("<HH", bytes(message.data[:4])) == (50, emulator.STRONG)
    finally:
        far_side.close()


@pytest.mark.parametrize("start", WIRES.values())
def test_it_cannot_stand_for_lights(start: Callable[..., Any]) -> None:
    with pytest.raises(Unsupported, match="lights"):
        start(ScriptedLights(), {})
