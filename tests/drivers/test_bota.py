"""Tests of the Bota SensONE: conformance, clock wrap, status bits, restart, faults."""

import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.bota import Bota, BotaOptions, framer
from drivers.emulators import bota as emulator
from drivers.emulators.scripted import ScriptedForceTorque, scripted_wrench
from drivers.transport.link import NoAnswer, Refused
from hal.conformance import ForceTorqueContract, Rig
from hal.devices import Wrench
from hal.errors import DeviceUnavailable
from hal.readings import Cause, Quality
from hal.registry import Context, connect
from tests.drivers.rigs import ScriptLink, count_good, soon, until, wired, wired_rig

DRIVER = "serial:bota"


class TestBota(ForceTorqueContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        with wired_rig(emulator.start(ScriptedForceTorque(), {}), DRIVER, sample_period_s=0.05) as rig:
            yield rig


def is_true(value: Wrench, reads: int) -> bool:
    index = round(value.force_n[0] / 0.01)
    true = scripted_wrench(index)
    same = np.allclose(value.force_n, true.force_n, rtol=1e-6) and np.allclose(
        value.torque_nm, true.torque_nm, rtol=1e-6
    )
    return bool(reads - 60 <= index <= reads and same)


@pytest.mark.parametrize(
    "fault", ["crc", "drop", "dup", "split", "delay", "silent", "garbage", "echo", "status", "disconnect"]
)
def test_no_fault_of_the_wire_gives_a_wrong_wrench(fault: str) -> None:
    backing = ScriptedForceTorque()
    options = {
        "fault": fault,
        "every": 20 if fault == "disconnect" else 4,
        "seed": 9,
        "delay_s": 0.05,
        "silent_s": 0.05,
        "away_s": 0.02,
    }
    with wired(emulator.start(backing, options), DRIVER) as device:
        assert count_good(device, lambda value: is_true(value, backing.reads)) >= 5


@pytest.mark.parametrize(
    ("status", "quality", "cause"),
    [
        (0, Quality.VALID, Cause.NONE),
        (1, Quality.DEGRADED, Cause.DEVICE),
        (2, Quality.INVALID, Cause.SATURATED),
        (4, Quality.INVALID, Cause.DEVICE),
        (8, Quality.INVALID, Cause.DEVICE),
    ],
)
def test_status_bits(status: int, quality: Quality, cause: Cause) -> None:
    device = Bota(Context(name="wrist"), BotaOptions(port="none"))
    device.receive(emulator.frame(scripted_wrench(3), status, 1000), 0.0)
    sample = device.mailbox.peek()
    assert sample is not None
    assert (sample.quality, sample.cause) == (quality, cause)


def test_a_frame_that_comes_twice_is_one_sample_taken_before_its_bytes_came() -> None:
    device = Bota(Context(name="wrist"), BotaOptions(port="none"))
    device.byte_s = 1e-3
    for _ in range(2):
        device.receive(emulator.frame(scripted_wrench(3), 0, 1000), 5.0)
    sample = device.mailbox.peek()
    assert sample is not None and device.mailbox.published == 1
    assert sample.host_time_s == pytest.approx(5.0 - 0.037)


def test_not_a_number_is_invalid() -> None:
    device = Bota(Context(name="wrist"), BotaOptions(port="none"))
    broken = Wrench(force_n=np.array([math.nan, 0.0, 0.0]), torque_nm=np.zeros(3))
    device.receive(emulator.frame(broken, 0, 1000), 0.0)
    sample = device.mailbox.peek()
    assert sample is not None and sample.quality is Quality.INVALID


def test_the_frame_is_37_bytes_with_the_crc_over_34() -> None:
    frame = emulator.frame(scripted_wrench(1), 0, 5)
    assert len(frame) == 37
    assert framer().feed(b"\xaa\x00" + frame) == [frame]
    assert struct.unpack("<I", frame[27:31]) == (5,)


def test_the_microsecond_clock_wraps_unseen() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {"clock_start_us": (1 << 32) - 100_000})
    with wired(far_side, DRIVER) as device:
        first = device.read_wrench(deadline=soon())
        until(lambda: far_side.stamp_us() < 10_000_000)
        last = device.newest(soon(), not_before_s=soon(0.0).at_s + 0.05)
    assert last.device_time_s - first.device_time_s == pytest.approx(last.host_time_s - first.host_time_s, abs=0.02)


def test_a_sensor_that_restarts_is_set_up_again() -> None:
    far_side = emulator.start(ScriptedForceTorque(), {})
    with wired(far_side, DRIVER) as device:
        far_side.restart()
        until(lambda: device.health().reconnects >= 1 and device.health().quality is Quality.VALID)
        assert far_side.is_running


class Sensor(ScriptLink):
    """Sensor that accepts commands only with a line end or, if not `reads_lines`, only without one."""

    def __init__(self, *, reads_lines: bool, refuses: str = "-") -> None:
        super().__init__()
        self.reads_lines, self.refuses = reads_lines, refuses
        self.understood: list[str] = []

    def write(self, data: bytes, until_s: float) -> None:
        text = data.decode()
        if text.endswith("\n") != self.reads_lines:
            return
        self.understood.append(text.strip())
        self.ready += f"r,{int(text.strip()[0] == self.refuses)},{text.strip()[0]},0\r\n".encode()


@pytest.mark.parametrize("reads_lines", [False, True])
def test_commands_are_understood_with_and_without_the_end_of_a_line(reads_lines: bool) -> None:
    device, link = Bota(Context(name="wrist"), BotaOptions(port="none")), Sensor(reads_lines=reads_lines)
    device.start(link)
    assert link.understood == ["C", "c,0,1,0,4", "f,512,0,0,0", "R"]


def test_a_sensor_that_does_not_know_its_output_command_is_set_up_all_the_same() -> None:
    device, link = Bota(Context(name="wrist"), BotaOptions(port="none")), Sensor(reads_lines=False, refuses="c")
    device.start(link)
    assert link.understood[-1] == "R"


def test_a_refused_filter_is_told_as_that() -> None:
    device, link = Bota(Context(name="wrist"), BotaOptions(port="none")), Sensor(reads_lines=False, refuses="f")
    with pytest.raises(Refused, match=r"refuses 'f,512,0,0,0': r,1,f,0"):
        device.start(link)


def test_a_power_up_text_that_comes_in_two_pieces_is_seen() -> None:
    device = Bota(Context(name="wrist"), BotaOptions(port="none"))
    device.receive(b"\xaa\x00App I", 0.0)
    with pytest.raises(NoAnswer, match="has restarted"):
        device.receive(b"nit\r\n", 0.0)


def test_another_device_on_the_port_is_told() -> None:
    from drivers.emulators import tfmini
    from drivers.emulators.scripted import ScriptedProximity

    far_side = tfmini.start(ScriptedProximity(), {})
    try:
        with pytest.raises(DeviceUnavailable, match="does not confirm"):
            connect(Context(name="wrist"), DRIVER, far_side.address)
    finally:
        far_side.close()
