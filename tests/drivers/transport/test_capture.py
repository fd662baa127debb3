"""A capture file of a link gives the same samples when it is replayed, whatever the protocol."""

import json
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.emulators import (
    bota,
    cia402,
    dynamixel,
    ft300,
    lms200,
    modbus_io,
    netft,
    ros2,
    rplidar,
    scip,
    scripted,
    tfmini,
    tfmini_i,
    ur,
)
from drivers.transport.capture import CaptureLink, ReplayLink, read_capture, replay_opener
from drivers.transport.fd_link import FdLink
from drivers.transport.link import Link, LinkLost, drain, now_s
from hal.devices import RangeImage
from hal.errors import CellError, ConfigError, DeviceUnavailable
from hal.readings import Stamped
from hal.registry import Context, connect
from tests.drivers.rigs import soon, until

SIDES: dict[str, tuple[Callable[..., Any], Callable[[], Any], str, dict[str, Any]]] = {
    "stream": (tfmini.start, scripted.ScriptedProximity, "serial:tfmini", {}),
    "stream with commands": (bota.start, scripted.ScriptedForceTorque, "serial:bota", {}),
    "modbus rtu": (tfmini_i.start_modbus, scripted.ScriptedProximity, "modbus:tfmini", {}),
    "modbus tcp": (modbus_io.start, scripted.ScriptedTouch, "modbus:touch", {"transport": "tcp"}),
    "registers": (ft300.start, scripted.ScriptedForceTorque, "modbus:ft300", {}),
    "udp": (netft.start, scripted.ScriptedForceTorque, "udp:netft", {}),
    "scip": (scip.start, scripted.ScriptedScanner, "scip:scanner", {}),
    "baud search": (lms200.start, scripted.ScriptedScanner, "serial:lms200", {}),
    "rplidar": (rplidar.start, scripted.ScriptedScanner, "serial:rplidar", {}),
    "can": (tfmini_i.start_can, scripted.ScriptedProximity, "can:tfmini", {}),
    "servos": (dynamixel.start, scripted.ScriptedArm, "serial:dynamixel", {}),
    "rosbridge": (ros2.start, scripted.ScriptedForceTorque, "ros2:force_torque", {}),
    "rtde": (ur.start, scripted.ScriptedArm, "ur:rtde", {}),
}
WANTED = 20


def samples_of(device: Any, wanted: int) -> list[Stamped[Any]]:
    """Return the first samples of the mailbox without gaps."""
    until(lambda: device.mailbox.published >= wanted, within_s=10.0)
    found, lost = device.mailbox.since(0)
    assert not lost
    return list(found[:wanted])


def plain(sample: Stamped[Any]) -> tuple[Any, ...]:
    """Return all fields of a sample except its host time."""
    value = sample.value
    told = value.depth_m.tobytes() if isinstance(value, RangeImage) else repr(value)
    return told, sample.sequence, sample.device_time_s, sample.quality, sample.cause


@pytest.mark.parametrize("name", SIDES)
def test_the_replay_of_a_capture_gives_the_same_samples(name: str, tmp_path: Path) -> None:
    start, backing, driver, far_options = SIDES[name]
    path = tmp_path / "capture.jsonl"
    far_side = start(backing(), far_options)
    with closing(far_side):
        options = far_side.address
        with closing(connect(Context(name="dut"), driver, {**options, "capture": str(path)})) as device:
            recorded = samples_of(device, WANTED)
    with closing(connect(Context(name="dut"), driver, {**options, "replay": str(path)})) as device:
        replayed = samples_of(device, WANTED)
    assert [plain(sample) for sample in replayed] == [plain(sample) for sample in recorded]
    lasted_s = [samples[-1].host_time_s - samples[0].host_time_s for samples in (recorded, replayed)]
    assert lasted_s[1] == pytest.approx(lasted_s[0], abs=2.0), "it goes at the pace of the recording"


def test_drives_that_their_host_paces_are_replayed_too(tmp_path: Path) -> None:
    """SYNC and heartbeat follow the host's clock, so not every sample of a recording on a busy machine is replayed."""
    path, arm = tmp_path / "capture.jsonl", scripted.ScriptedArm()
    with closing(cia402.start(arm, {})) as far_side:
        options = far_side.address
        with closing(connect(Context(name="dut"), "can:cia402", {**options, "capture": str(path)})) as device:
            samples_of(device, 2 * WANTED)
    with closing(connect(Context(name="dut"), "can:cia402", {**options, "replay": str(path)})) as device:
        replayed = samples_of(device, 5)
    assert all(np.allclose(sample.value.position_rad, arm.position_rad, atol=1e-4) for sample in replayed)


def test_the_end_of_a_recording_is_the_loss_of_the_device(tmp_path: Path) -> None:
    path = tmp_path / "capture.jsonl"
    with closing(tfmini.start(scripted.ScriptedProximity(), {})) as far_side:
        options = {**far_side.address, "capture": str(path)}
        with closing(connect(Context(name="dut"), "serial:tfmini", options)) as device:
            samples_of(device, 5)
    with closing(connect(Context(name="dut"), "serial:tfmini", {"port": "x", "replay": str(path)})) as device:
        until(lambda: isinstance(device.mailbox.error(), DeviceUnavailable))
        with pytest.raises(DeviceUnavailable, match=r"dut.*has ended"):
            device.newest(soon(0.5), not_before_s=soon(0.0).at_s)


def session(path: Path, *events: tuple[float, str, bytes]) -> Link:
    """Return a replay of these events."""
    lines = [{"t": t, "dir": direction, "hex": data.hex()} for t, direction, data in events]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return replay_opener(path, "dut")()


def test_an_answer_is_held_back_until_its_request_is_written(tmp_path: Path) -> None:
    link = session(tmp_path / "c", (0.0, "tx", b"ask"), (0.001, "rx", b"answer"))
    assert link.read(0.0) == b"", "draining before a request must not eat its answer"
    link.write(b"ask", now_s() + 1.0)
    assert link.read(now_s() + 1.0) == b"answer"
    with pytest.raises(LinkLost, match="end"):
        link.read(now_s() + 1.0)


def test_a_request_that_nobody_makes_is_passed_over(tmp_path: Path) -> None:
    link = session(tmp_path / "c", (0.0, "tx", b"beat"), (0.002, "rx", b"data"), (0.01, "rx", b"more"))
    assert link.read(now_s() + 2.0) == b"data"
    link.write(b"beat", now_s() + 1.0)  # too late; nothing is skipped because of it
    assert link.read(now_s() + 1.0) == b"more"


def test_draining_takes_what_was_read_for_a_request_that_is_not_made(tmp_path: Path) -> None:
    events = ((0.0, "tx", b"a"), (0.0, "rx", b"A"), (0.0, "rx", b""), (0.0, "tx", b"b"), (0.0, "rx", b"B"))
    link = session(tmp_path / "c", *events)
    assert link.read(now_s() + 1.0) == b"A"
    assert drain(link) == b""
    link.write(b"b", now_s() + 1.0)
    assert link.read(now_s() + 1.0) == b"B"


def test_silence_before_a_request_is_not_taken_for_the_silence_after_it(tmp_path: Path) -> None:
    events = ((0.0, "rx", b""), (0.0, "rx", b""), (0.0, "rx", b""), (0.0, "tx", b"a"), (0.0, "rx", b"A"))
    link = session(tmp_path / "c", *events)
    assert drain(link) == b""
    link.write(b"a", now_s() + 1.0)
    assert link.read(now_s() + 1.0) == b"A"


def test_nothing_comes_before_its_time(tmp_path: Path) -> None:
    link = session(tmp_path / "c", (1.0, "rx", b"late"))
    started_s = now_s()
    assert link.read(started_s + 0.05) == b""
    assert link.read(started_s + 30.0) == b"late"
    assert now_s() >= started_s + 1.0


def test_a_write_that_was_never_recorded_changes_nothing(tmp_path: Path) -> None:
    link = session(tmp_path / "c", (0.0, "rx", b"data"), (5.0, "tx", b"far"), (5.0, "rx", b"answer"))
    link.write(b"strange", now_s() + 1.0)
    link.write(b"far", now_s() + 1.0)
    assert link.read(now_s() + 1.0) == b"data"


class TwiceLost:
    """Port that delivers one chunk after each opening and is then lost."""

    name, byte_s = "wire", 1e-4

    def __init__(self, *chunks: bytes) -> None:
        self.chunks = list(chunks)

    def read(self, until_s: float) -> bytes:
        if not self.chunks:
            raise LinkLost("gone")
        return self.chunks.pop()

    def write(self, data: bytes, until_s: float) -> None:
        """Discard the data."""

    def is_present(self) -> bool:
        return True

    def close(self) -> None:
        """Do nothing."""


@pytest.fixture
def lost_twice(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "capture.jsonl"
    for chunk in (b"first", b"second"):
        with closing(CaptureLink(TwiceLost(chunk), path)) as link:
            link.read(now_s())
    yield path


def test_each_opening_of_the_port_is_a_session(lost_twice: Path) -> None:
    first, second = read_capture(lost_twice)
    assert (first.name, first.byte_s) == ("wire", 1e-4)
    opened = replay_opener(lost_twice, "dut")
    assert [opened().read(now_s() + 1.0), opened().read(now_s() + 1.0)] == [b"first", b"second"]
    assert ReplayLink(second).name == "replay of wire"
    with pytest.raises(DeviceUnavailable, match=r"dut: the recording capture\.jsonl has ended"):
        opened()


def test_a_capture_whose_writer_was_killed_is_read_to_its_last_whole_line(lost_twice: Path) -> None:
    lost_twice.write_text(lost_twice.read_text()[:-9])
    assert [len(s.events) for s in read_capture(lost_twice)] == [1, 0]


@pytest.mark.parametrize(
    "text", ['{"t": 0, "dir": "rx"}\n{}\n', "nonsense\n\n", '{"t": 0, "dir": "rx", "hex": "0"}\n\n']
)
def test_a_file_that_is_no_capture_is_refused_with_its_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "c"
    path.write_text(text)
    with pytest.raises(ConfigError, match="line 1"):
        read_capture(path)


def test_a_capture_that_cannot_be_written_says_so_and_leaves_the_port_free(tmp_path: Path) -> None:
    emulator = tfmini.start(scripted.ScriptedProximity(), {})
    with closing(emulator):
        options = {**emulator.address, "capture": str(tmp_path / "no_such_folder" / "wire.jsonl")}
        with pytest.raises(DeviceUnavailable, match=r"capture .*no_such_folder.* cannot be written"):
            connect(Context(name="finger"), "serial:tfmini", options)


def test_a_link_that_was_closed_meanwhile_is_lost_and_no_defect_when_it_is_captured(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair()
    with closing(theirs):
        ours.setblocking(False)
        link = CaptureLink(FdLink(ours.detach(), "socket"), tmp_path / "wire.jsonl")
        link.close()
        with pytest.raises(LinkLost):
            link.write(b"x", now_s())


def test_a_missing_capture_is_an_error_of_the_options(tmp_path: Path) -> None:
    with pytest.raises(CellError, match="cannot be read"):
        connect(Context(name="dut"), "serial:tfmini", {"port": "x", "replay": str(tmp_path / "none")})
