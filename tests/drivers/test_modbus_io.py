"""Tests of remote I/O: conformance over TCP and RTU, several devices on one bus, faults, pymodbus as client."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from drivers.emulators import modbus_io as emulator
from drivers.emulators.scripted import ScriptedLights, ScriptedProximity, ScriptedTouch
from drivers.modbus_io import LightsOptions
from hal.conformance import LightsContract, ProximityContract, Rig, TouchContract
from hal.errors import ConfigError, DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from tests.drivers.rigs import soon, until, wired, wired_rig

TRANSPORTS = ("tcp", "rtu")
PERIOD_S = 0.06


@pytest.fixture(params=TRANSPORTS)
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class TestLights(LightsContract):
    @pytest.fixture
    def rig(self, transport: str) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedLights(), {"transport": transport})
        with wired_rig(far_side, "modbus:lights", sample_period_s=PERIOD_S) as rig:
            yield rig


class TestTouch(TouchContract):
    @pytest.fixture
    def rig(self, transport: str) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedTouch(), {"transport": transport})
        with wired_rig(far_side, "modbus:touch", sample_period_s=PERIOD_S) as rig:
            yield rig


class TestSwitch(ProximityContract):
    @pytest.fixture
    def rig(self, transport: str) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedProximity(fixed_m=0.01), {"transport": transport})
        with wired_rig(far_side, "modbus:proximity", sample_period_s=PERIOD_S) as rig:
            yield rig


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo"])
def test_no_fault_of_the_wire_gives_wrong_feedback(fault: str, transport: str) -> None:
    options = {"transport": transport, "fault": fault, "every": 3, "seed": 3, "delay_s": 0.15, "silent_s": 0.15}
    lights = ScriptedLights()
    with wired(emulator.start(lights, options), "modbus:lights") as device:
        for i in range(6):
            wanted = tuple(bool(i >> k & 1) for k in range(4))
            try:
                device.set_on(wanted, deadline=soon())
            except DeviceTimeout:
                continue  # an error was reported, as it should be
            assert lights.on == wanted
            try:
                assert device.read_on(deadline=soon()).value == wanted
            except DeviceTimeout:
                continue


def test_the_devices_error_report_is_a_fault(transport: str) -> None:
    far_side = emulator.start(ScriptedLights(), {"transport": transport})
    with wired(far_side, "modbus:lights", {"outputs": [6, 7, 8, 9]}) as device:
        with pytest.raises(DeviceFault, match="no such address") as caught:
            device.set_on([True] * 4, deadline=soon())
        assert caught.value.details["code"] == 2


def test_the_device_says_who_it_is_and_another_one_is_refused(transport: str) -> None:
    far_side = emulator.start(ScriptedLights(), {"transport": transport})
    with wired(far_side, "modbus:lights", {"product": "modbus_io 1."}) as device:
        assert "; panelwright modbus_io 1.0; " in device.health().detail
    far_side = emulator.start(ScriptedLights(), {"transport": transport})
    said = r"says that it is 'panelwright modbus_io 1.0', not 'ioLogik'"
    with pytest.raises(DeviceUnavailable, match=said), wired(far_side, "modbus:lights", {"product": "ioLogik"}):
        pass


def test_an_open_stop_circuit_degrades_the_feedback(transport: str) -> None:
    far_side = emulator.start(ScriptedLights(), {"transport": transport})
    with wired(far_side, "modbus:lights") as device:
        assert device.read_on(deadline=soon()).quality is Quality.VALID
        far_side.table.is_healthy = False
        device.set_on([True] * 4, deadline=soon())
        sample = device.read_on(deadline=soon())
    assert (sample.quality, sample.cause) == (Quality.DEGRADED, Cause.DEVICE)


def test_touch_and_switch_share_the_lights_bus() -> None:
    far_side = emulator.start(ScriptedLights(), {})
    context = Context(name="lights")
    lights = connect(context, "modbus:lights", far_side.address)
    touch = connect(Context(name="touch", shared=context.shared), "modbus:touch", far_side.address)
    try:
        assert touch.bus is lights.bus
        assert touch.read_contacts(deadline=soon()).value == (False, False)
        lights.close()
        assert touch.read_contacts(deadline=soon()).value == (False, False)
    finally:
        touch.close()
        far_side.close()


def test_a_bus_that_all_have_left_can_be_joined_again() -> None:
    far_side = emulator.start(ScriptedTouch(), {})
    context = Context(name="touch")
    try:
        for _ in range(3):
            device = connect(context, "modbus:touch", far_side.address)
            assert device.read_contacts(deadline=soon()).value == (False, False)
            device.close()
    finally:
        far_side.close()


def test_close_leaves_the_lights_off() -> None:
    lights = ScriptedLights()
    with wired(emulator.start(lights, {}), "modbus:lights") as device:
        device.set_on([True] * 4, deadline=soon())
        device.close()
        assert lights.on == (False,) * 4


def test_after_unplugging_the_lights_are_as_commanded() -> None:
    lights = ScriptedLights()
    with wired(far_side := emulator.start(lights, {}), "modbus:lights") as device:
        device.set_on([True, False, False, True], deadline=soon())
        lights.on = (False,) * 4
        far_side.unplug(away_s=0.05)
        until(lambda: lights.on == (True, False, False, True))


def test_the_switch_knows_near_and_says_nothing_of_far() -> None:
    backing = ScriptedProximity(fixed_m=0.01)
    with wired(emulator.start(backing, {}), "modbus:proximity") as device:
        near = device.read_distance_m(deadline=soon())
        assert (near.value, near.quality) == (0.02, Quality.DEGRADED)
        backing.fixed_m = 0.5
        far = device.newest(soon(), not_before_s=soon(0.0).at_s + 0.005)
    assert math.isnan(far.value)
    assert far.quality is Quality.INVALID


@pytest.mark.parametrize(
    ("driver", "options", "message"),
    [
        ("modbus:lights", {"outputs": [0, 1]}, "same number"),
        ("modbus:lights", {"feedback": [0, 1, 2, 9]}, "only inputs 0 to 7"),
        ("modbus:touch", {"contacts": [4]}, "same number"),
        ("modbus:proximity", {"input": 12}, "only inputs 0 to 7"),
        ("modbus:lights", {"unit": 300}, r"options: unit"),
    ],
)
def test_wrong_wiring_is_refused(driver: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        connect(Context(name="io"), driver, {"host": "127.0.0.1", "port": 502, **options})


def test_a_host_alone_is_modbus_tcp_at_its_usual_port_and_no_address_is_refused() -> None:
    assert LightsOptions(host="10.0.0.30").wire == "tcp 10.0.0.30:502"
    with pytest.raises(ConfigError, match=r"options: say where the device is"):
        connect(Context(name="io"), "modbus:lights", {})


@pytest.mark.third_party("pymodbus", "modbus:lights", "modbus:touch", "modbus:proximity")
def test_pymodbus_reads_the_registers_that_the_notes_describe(transport: str) -> None:
    """Its client and its server classes share their encoding; minimalmodbus checks that (see test_other_sides)."""
    lights = ScriptedLights()
    far_side = emulator.start(lights, {"transport": transport})
    if transport == "tcp":
        client: Any = ModbusTcpClient("127.0.0.1", port=far_side.address["port"], timeout=1, retries=0)
    else:
        client = ModbusSerialClient(far_side.address["port"], baudrate=115_200, timeout=1, retries=0)
    try:
        assert client.connect()
        assert not client.write_coils(0, [True, False, True, True], device_id=1).isError()
        assert lights.on == (True, False, True, True)
        inputs = client.read_discrete_inputs(0, count=8, device_id=1).bits[:8]
        assert inputs == [True, False, True, True, False, False, False, True]
        assert client.read_input_registers(0x30, count=1, device_id=1).registers == [0b1000_1101]
        assert client.read_holding_registers(0x20, count=1, device_id=1).registers == [0b1101]
        assert not client.write_coil(1, True, device_id=1).isError()
        assert lights.on == (True, True, True, True)
        assert client.read_coils(0, count=8, device_id=1).bits[:4] == [True] * 4
        assert client.read_input_registers(0x10, count=2, device_id=1).registers == [0, 1]
        assert client.read_coils(7, count=2, device_id=1).exception_code == 2
        assert not client.write_register(0x20, 0b0101, device_id=1).isError()
        assert lights.on == (True, False, True, False)
        names = client.read_device_information(device_id=1).information
        assert names == {0: b"panelwright", 1: b"modbus_io", 2: b"1.0"}
    finally:
        client.close()
        far_side.close()
