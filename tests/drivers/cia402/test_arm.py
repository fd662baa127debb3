"""Tests of the CiA-402 arm over slcan and a virtual bus: conformance, watchdog, emergencies, restarts, faults."""

import struct
import threading
from collections.abc import Iterator
from typing import Any, cast

import can
import canopen
import numpy as np
import pytest

from drivers.cia402.arm import Cia402
from drivers.cia402.options import Cia402Options
from drivers.cia402.states import DriveState
from drivers.emulators import cia402 as emulator
from drivers.emulators.scripted import ScriptedArm
from drivers.kinds.arms import kinematics_of
from drivers.transport.can_frames import CanFrame, record
from drivers.transport.link import NoAnswer
from drivers.transport.options import read_options
from hal.conformance import ArmContract, Rig
from hal.errors import CellError, DeviceFault, DeviceUnavailable, MotionRefused
from hal.registry import Context, connect
from tests.drivers.rigs import count_good, soon, until, wired, wired_rig

DRIVER = "can:cia402"
CALM = {"heartbeat_s": 1.0}  # long, so that a busy test machine is not taken for a dead host


class TestCia402(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedArm(), {}), DRIVER, CALM, sample_period_s=0.1) as rig:
            yield rig


class TestOverTcp(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedArm(), {"transport": "tcp"})
        with wired_rig(far_side, DRIVER, CALM, sample_period_s=0.1) as rig:
            yield rig


class TestOverAVirtualBus(ArmContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = emulator.start(ScriptedArm(), {"transport": "virtual"})
        with wired_rig(far_side, DRIVER, CALM, sample_period_s=0.1) as rig:
            yield rig


@pytest.mark.parametrize("transport", ["serial", "virtual"])
@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "disconnect"])
def test_no_fault_of_the_bus_gives_wrong_joints(fault: str, transport: str) -> None:
    arm = ScriptedArm()
    options = {
        "transport": transport,
        "fault": fault,
        "every": 500 if fault == "disconnect" else 50,  # the set-up alone takes about 50 frames
        "seed": 8,
        "delay_s": 0.05,
        "silent_s": 0.05,
        "away_s": 0.02,
        "split_s": 0.01,
    }
    with wired(emulator.start(arm, options), DRIVER, {**CALM, "rate_hz": 50.0}) as device:
        assert count_good(device, lambda s: np.allclose(s.position_rad, arm.position_rad, atol=1e-5), wanted=3) >= 3


class Unread:
    """Link without a device: the test itself supplies the answers."""

    name = "unread"

    def __init__(self) -> None:
        self.written = b""

    def write(self, data: bytes, until_s: float) -> None:
        assert until_s > 0.0
        self.written += data


def pdos(node: int, number: int, copies: int = 1) -> bytes:
    """Return both PDOs of a drive, `copies` times each, with the number of the SYNC as position."""
    frames = (0x180, struct.pack("<Hi", 0x27, number)), (0x280, struct.pack("<ih", number, 0))
    return b"".join(copies * record(CanFrame(function + node, data)) for function, data in frames)


def test_a_repeated_pdo_is_not_taken_for_the_answer_to_the_next_sync() -> None:
    """Two SYNCs are unanswered, and the last drive's answers to the first one arrive twice."""
    context, c = Context(name="arm"), ScriptedArm().capabilities()
    options = {"channel": "/dev/unread", "nodes": [*range(1, 7)], "kinematics": kinematics_of(c)}
    device, link = Cia402(context, read_options(context, options, Cia402Options)), cast(Any, Unread())
    seen = []
    for number, cycles in ((1, 1), (2, 2), (3, 0), (4, 1)):
        for _ in range(cycles):
            device._cycle(link)
        for node in range(1, 7):
            device.receive(pdos(node, number, copies=2 if (node, number) == (6, 2) else 1), 0.0)
            if (sample := device.mailbox.peek()) is not None:
                seen.append(np.degrees(sample.value.position_rad) * 1000)
    assert link.written.count(record(CanFrame(0x080, b""))) == 4
    assert np.ptp(seen, axis=1).max() < 0.5, "joints of different moments"
    np.testing.assert_allclose(seen[-1], 4)


def lone_arm() -> Cia402:
    options = {"channel": "/dev/unread", "kinematics": kinematics_of(ScriptedArm().capabilities())}
    context = Context(name="arm")
    return Cia402(context, read_options(context, options, Cia402Options))


@pytest.mark.parametrize(("state", "told"), [(4, "stopped"), (0x7F, "pre-operational")])
def test_a_drive_whose_heartbeat_says_that_it_is_not_operational_is_named_at_once(state: int, told: str) -> None:
    with pytest.raises(NoAnswer, match=f"node 3 says that it is {told}"):
        lone_arm().receive(record(CanFrame(0x703, bytes([state]))), 10.0)


def test_pdos_of_a_wrong_length_are_named() -> None:
    device = lone_arm()
    device.receive(record(CanFrame(0x182, bytes(4))), 10.0)
    assert "node 2 sends PDOs of 4 bytes, not 6" in device.wire_counts()
    assert device.errors == 1


def test_drives_that_answer_no_sync_and_their_emergencies_are_named() -> None:
    device, link = lone_arm(), cast(Any, Unread())
    for _ in range(5):
        device._cycle(link)
        for node in (1, 2, 3, 5, 6):
            device.receive(pdos(node, 7), 0.0)
    assert device.wire_counts().endswith("nodes that answer no SYNC: 4")
    device.receive(record(CanFrame(0x085, bytes.fromhex("1186200000000000"))), 0.0)
    assert "5: operation_enabled, emergency 8611h" in str(device._not_enabled())


def test_enabling_takes_the_measured_position_as_target() -> None:
    arm = ScriptedArm()
    before = arm.position_rad.copy()
    with wired(emulator.start(arm, {}), DRIVER, CALM) as device:
        device.enable(deadline=soon())
        until(lambda: arm.commands > 3)
        np.testing.assert_allclose(arm.position_rad, before, atol=1e-5)


def test_a_dead_host_faults_the_drives_by_their_own_watchdog() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, CALM) as device:
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        device._next_beat_s = float("inf")  # no more heartbeats, as from a dead host
        until(lambda: not arm.is_enabled)
        assert far_side.drives[1].state is DriveState.FAULT


def test_an_emergency_is_a_fault_and_only_enable_resets_it() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, CALM) as device:
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        far_side.fault(0x2310)
        with pytest.raises((DeviceFault, MotionRefused)):
            until(lambda: device.command_position(arm.position_rad, deadline=soon()) is None)
        until(lambda: not arm.is_enabled)
        threading.Event().wait(0.1)
        assert far_side.drives[1].state is DriveState.FAULT
        until(lambda: device.mailbox.error() is None)
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)


def test_a_drive_that_restarts_is_set_up_again_and_stays_off() -> None:
    arm = ScriptedArm()
    with wired(far_side := emulator.start(arm, {}), DRIVER, CALM) as device:
        device.enable(deadline=soon())
        until(lambda: arm.is_enabled)
        far_side.restart(3)
        until(lambda: device.health().reconnects == 1 and device.mailbox.error() is None)
        assert not arm.is_enabled
        assert far_side.drives[3].objects[(0x6060, 0)] == b"\x08"
        with pytest.raises(MotionRefused):
            device.command_position(arm.position_rad, deadline=soon())


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts to connect end after 3 s; the drives are asked for the cause much earlier."""
    monkeypatch.setattr("drivers.cia402.arm.CONNECT_S", 3.0)


@pytest.mark.usefixtures("hurried")
def test_a_wrong_pdo_mapping_is_refused() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    far_side.drives[2].objects[(0x1A00, 2)] = struct.pack("<I", 0x606C0020)
    with pytest.raises(CellError, match="node 2: object 1A00h"), wired(far_side, DRIVER):
        raise AssertionError("it connected")


@pytest.mark.usefixtures("hurried")
def test_a_missing_node_is_named() -> None:
    far_side = emulator.start(ScriptedArm(), {})
    try:
        with pytest.raises(DeviceUnavailable, match="node 9"):
            connect(Context(name="arm"), DRIVER, {**far_side.address, "nodes": [1, 2, 3, 4, 5, 9]})
    finally:
        far_side.close()


@pytest.mark.third_party("canopen", "can:cia402")
def test_python_can_and_canopen_drive_the_emulator() -> None:
    """The emulator works with a third-party stack: NMT, SDO read, write and abort, 402 states, PDOs on SYNC."""
    arm = ScriptedArm()
    far_side = emulator.start(arm, {})
    bus = can.Bus(interface="slcan", channel=far_side.port.address["port"], bitrate=1_000_000, sleep_after_open=0)
    network = canopen.Network(bus)
    try:
        network.connect()
        node = network.add_node(1, canopen.ObjectDictionary())
        assert node.sdo.upload(0x1000, 0) == struct.pack("<I", 0x20192)
        node.sdo.download(0x6060, 0, b"\x08")
        assert node.sdo.upload(0x6060, 0) == b"\x08"
        with pytest.raises(canopen.SdoAbortedError) as caught:
            node.sdo.upload(0x5555, 0)
        assert caught.value.code == 0x06020000
        seen: dict[int, bytes] = {}
        network.subscribe(0x181, lambda cob, data, stamp: seen.update({cob: bytes(data)}))
        network.send_message(0, bytes([1, 0]))
        for word, status in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27), (0x0B, 0x07)):
            seen.clear()
            network.send_message(0x201, struct.pack("<Hi", word, 5730))
            network.send_message(0x80, b"")
            until(lambda: 0x181 in seen)
            assert struct.unpack("<Hi", seen[0x181]) == (status, round(np.degrees(0.1) * 1000))
    finally:
        network.disconnect()
        far_side.close()
