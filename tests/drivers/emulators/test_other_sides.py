"""Third-party clients with our emulators, so that no protocol is verified by this project's code only.

The clients are installed by the `test` extra. Further ones, pymodbus, python-can and canopen, are used in
test_modbus_io, test_ft300 and `cia402`. The client for the LMS 200 is in the Debian package mrpt-apps. There is none
for Bota and TFmini, so only their checksums are compared, with libscrc.
"""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators import dynamixel, dynamixel_gripper, ft300, netft, robotiq_2f
from drivers.emulators.scripted import ScriptedArm, ScriptedForceTorque, ScriptedGripper, scripted_wrench
from drivers.transport.checks import crc_dynamixel, crc_modbus, crc_x25
from tests.drivers.rigs import until


@given(st.binary(max_size=64))
def test_libscrc_agrees(data: bytes) -> None:
    libscrc = pytest.importorskip("libscrc")
    assert crc_modbus(data) == libscrc.modbus(data)
    assert crc_x25(data) == libscrc.x25(data)
    assert crc_dynamixel(data) == libscrc.buypass(data)


@pytest.mark.third_party("dynamixel-sdk", "serial:dynamixel")
def test_dynamixel_sdk_reads_writes_and_sync_reads() -> None:
    sdk: Any = pytest.importorskip("dynamixel_sdk")
    sdk.port_handler.LATENCY_TIMER = 500  # ms; the default of 16 ms is too short on a busy machine
    arm = ScriptedArm()
    far_side = dynamixel.start(arm, {})
    port, packet = sdk.PortHandler(far_side.address["port"]), sdk.PacketHandler(2.0)
    try:
        assert port.openPort() and port.setBaudRate(1_000_000)
        assert packet.ping(port, 3) == (1020, sdk.COMM_SUCCESS, 0)
        counts, result, error = packet.read4ByteTxRx(port, 2, 132)
        assert (result, error) == (sdk.COMM_SUCCESS, 0)
        assert np.int32(np.uint32(counts)) == round(arm.position_rad[1] / (2 * np.pi / 4096)) + 2048
        for id_ in range(1, 7):
            assert packet.write1ByteTxRx(port, id_, 64, 1) == (sdk.COMM_SUCCESS, 0)
        until(lambda: arm.is_enabled)
        assert packet.write1ByteTxRx(port, 1, 11, 1)[1] == dynamixel.ACCESS
        group = sdk.GroupSyncRead(port, packet, 132, 4)
        for id_ in range(1, 7):
            group.addParam(id_)
        assert group.txRxPacket() == sdk.COMM_SUCCESS
        assert group.fastSyncRead() == sdk.COMM_SUCCESS
        for id_, angle in zip(range(1, 7), arm.position_rad, strict=True):
            assert group.isAvailable(id_, 132, 4)
            assert np.int32(np.uint32(group.getData(id_, 132, 4))) == round(angle / (2 * np.pi / 4096)) + 2048
        write = sdk.GroupSyncWrite(port, packet, 116, 4)
        for id_ in range(1, 7):
            write.addParam(id_, list((2048 + 10 * id_).to_bytes(4, "little")))
        assert write.txPacket() == sdk.COMM_SUCCESS
        until(lambda: bool(np.allclose(arm.position_rad, np.arange(1, 7) * 10 * 2 * np.pi / 4096)))
    finally:
        port.closePort()
        far_side.close()


@pytest.mark.third_party("dynamixel-sdk", "serial:dynamixel_gripper")
def test_dynamixel_sdk_closes_the_gripper_and_reads_where_it_stopped() -> None:
    sdk: Any = pytest.importorskip("dynamixel_sdk")
    sdk.port_handler.LATENCY_TIMER = 500  # ms
    gripper = ScriptedGripper(object_m=0.04)
    far_side = dynamixel_gripper.start(gripper, {})
    port, packet = sdk.PortHandler(far_side.address["port"]), sdk.PacketHandler(2.0)
    try:
        assert port.openPort() and port.setBaudRate(1_000_000)
        assert packet.ping(port, dynamixel_gripper.ID) == (1020, sdk.COMM_SUCCESS, 0)
        assert packet.write1ByteTxRx(port, dynamixel_gripper.ID, 64, 1) == (sdk.COMM_SUCCESS, 0)
        closed = dynamixel_gripper.CLOSED_COUNT
        assert packet.write4ByteTxRx(port, dynamixel_gripper.ID, 116, closed) == (sdk.COMM_SUCCESS, 0)
        share = 0.04 / far_side.address["stroke_m"]
        held = round(closed + share * (dynamixel_gripper.OPEN_COUNT - closed))
        until(lambda: abs(packet.read4ByteTxRx(port, dynamixel_gripper.ID, 132)[0] - held) <= 2)
    finally:
        port.closePort()
        far_side.close()


@pytest.mark.third_party("minimalmodbus", "modbus:ft300", "modbus:robotiq_2f")
def test_minimalmodbus_reads_the_sensor_and_works_the_gripper() -> None:
    minimalmodbus: Any = pytest.importorskip("minimalmodbus")
    sensor, gripper = ft300.start(ScriptedForceTorque(), {}), robotiq_2f.start(ScriptedGripper(), {})
    try:
        instrument = minimalmodbus.Instrument(sensor.address["port"], 9, close_port_after_each_call=True)
        instrument.serial.timeout = 1.0
        instrument.serial.baudrate = 19_200
        words = instrument.read_registers(180, 6, functioncode=4)
        assert np.int16(np.uint16(words[1])) == pytest.approx(100 * scripted_wrench(1).force_n[1], abs=0.6)
        instrument = minimalmodbus.Instrument(gripper.address["port"], 9, close_port_after_each_call=True)
        instrument.serial.timeout = 1.0
        instrument.serial.baudrate = 115_200
        instrument.write_registers(1000, [0, 0, 0])
        instrument.write_registers(1000, [0x0100, 0, 0])
        until(lambda: instrument.read_register(2000) >> 12 & 3 == 3)
        instrument.write_registers(1000, [0x0900, 255, 0xFFFF])
        until(lambda: instrument.read_register(2000) >> 14 == 3)
        assert instrument.read_registers(2000, 3)[2] >> 8 >= 228
    finally:
        sensor.close()
        gripper.close()


@pytest.mark.third_party("NetFT", "udp:netft")
def test_netft_reads_a_record() -> None:
    module: Any = pytest.importorskip("NetFT")
    far_side = netft.start(ScriptedForceTorque(), {"udp_port": 49_152})
    try:
        counts = module.Sensor("127.0.0.1").getMeasurement()
        true = scripted_wrench(1)
        np.testing.assert_allclose(np.array(counts) / 1e6, [*true.force_n, *true.torque_nm], atol=1e-6)
    finally:
        far_side.close()
