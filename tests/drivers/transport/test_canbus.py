"""Tests of the link over python-can: choice of the adapter, frames, time stamps, errors, capture and replay."""

import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
import pytest

from drivers.emulators import tfmini_i
from drivers.emulators.scripted import ScriptedProximity
from drivers.tfmini_i import CanTfminiOptions
from drivers.transport.can_frames import EXTENDED, CanFrame, FrameReader, record
from drivers.transport.canbus import CanLink, can_opener
from drivers.transport.link import LinkLost, Refused, now_s
from drivers.transport.options import read_options
from hal.errors import ConfigError, DeviceUnavailable
from hal.registry import Context, connect
from tests.drivers.rigs import later, soon, wired


def options(**given: Any) -> CanTfminiOptions:
    return read_options(Context(name="finger"), given, CanTfminiOptions)


@pytest.mark.parametrize(
    ("given", "adapter", "wire", "is_shared"),
    [
        ({"channel": "/dev/ttyACM0"}, "slcan", "serial /dev/ttyACM0", False),
        ({"channel": "tcp://host:4000"}, "slcan", "CAN tcp://host:4000", True),
        ({"channel": "can0"}, "socketcan", "CAN can0", True),
        ({"channel": "vcan0", "interface": "virtual"}, "virtual", "CAN vcan0", True),
        ({"channel": "PCAN_USBBUS1", "interface": "pcan"}, "pcan", "CAN pcan PCAN_USBBUS1", False),
        ({"channel": 0, "interface": "kvaser"}, "kvaser", "CAN kvaser 0", False),
    ],
)
def test_the_channel_tells_the_adapter_unless_it_is_given(
    given: dict[str, Any], adapter: str, wire: str, is_shared: bool
) -> None:
    found = options(**given)
    (claim,) = found.claims()
    assert (found.adapter, claim.wire, claim.bus is not None) == (adapter, wire, is_shared)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"channel": "tcp://"}, "HOST:PORT"),
        ({"channel": "tcp://127.0.0.1"}, "HOST:PORT"),
        ({"channel": "tcp://:4000"}, "HOST:PORT"),
        ({"channel": "tcp://host:70000"}, "HOST:PORT"),
        ({"channel": "tcp://host:x"}, "HOST:PORT"),
        ({"channel": "x", "interface": "socketca"}, "is it 'socketcan'"),
        ({"channel": "x", "interface": "abacus9"}, "python-can has"),
        ({"channel": 0}, "give `interface` too"),
        ({"channel": "/dev/ttyACM0", "bitrate": 83_333}, "bitrate: an slcan adapter has"),
    ],
)
def test_what_cannot_be_opened_is_a_fault_of_the_cell_file(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        options(**given)


@pytest.mark.parametrize(
    ("given", "told", "remedy"),
    [
        ({"channel": "nocan7"}, "nocan7", "sudo ip link set nocan7 up type can bitrate 250000"),
        ({"channel": "/dev/nowhere"}, "finger: port /dev/nowhere", "ports now"),
        ({"channel": "c", "interface": "nixnet"}, "finger: CAN nixnet c", "install the maker's driver"),
        ({"channel": "/dev/null", "adapter_options": {"colour": 1}}, "colour", "adapter_options"),
    ],
)
def test_an_adapter_that_does_not_open_is_named_with_a_remedy(given: dict[str, Any], told: str, remedy: str) -> None:
    opener, _ = can_opener(options(**given), "finger")
    with pytest.raises(DeviceUnavailable) as caught:
        opener()
    assert told in caught.value.what and remedy in caught.value.hint


@pytest.fixture
def channel() -> str:
    return uuid4().hex


@pytest.fixture
def far(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(channel, "virtual") as bus:
        yield bus


@pytest.fixture
def link(channel: str, far: can.BusABC) -> Iterator[Any]:
    opener, _ = can_opener(options(channel=channel, interface="virtual", adapter_options={"rx_queue_size": 600}), "x")
    with closing(opener()) as link:
        yield link


def test_frames_go_both_ways_with_short_long_and_fd_identifiers_and_data(far: can.BusABC, link: Any) -> None:
    sent = [CanFrame(0x181, b"12345678"), CanFrame(0x181 | EXTENDED, b""), CanFrame(3, bytes(24))]
    link.write(b"".join(map(record, sent)), later())
    messages = [far.recv(1.0) for _ in sent]
    assert [m.is_extended_id for m in messages if m] == [False, True, False]
    assert [m.is_fd for m in messages if m] == [False, False, True]
    for message in messages:
        assert message is not None
        far.send(message)
    chunk = link.read(later())
    assert [(f.id, f.data) for f in FrameReader().feed(chunk, now_s())] == [(f.id, f.data) for f in sent]
    assert link.received == len(chunk)


def test_remote_frames_error_frames_and_silence_give_no_frames(far: can.BusABC, link: Any) -> None:
    far.send(can.Message(arbitration_id=3, is_remote_frame=True, is_extended_id=False))
    far.send(can.Message(arbitration_id=3, is_error_frame=True, is_extended_id=False))
    assert link.read(later(0.01)) == b""
    assert link.read(now_s()) == b""


def test_the_adapters_time_stamp_dates_a_frame_that_was_held_up() -> None:
    reader = FrameReader()
    for number in range(10):
        list(reader.feed(record(CanFrame(3, b""), 500.0 + number), 10.0 + number))
    (late,) = reader.feed(record(CanFrame(3, b""), 510.0), 20.4)
    assert late.arrived_s == pytest.approx(20.0)
    (without,) = reader.feed(record(CanFrame(3, b"")), 21.0)
    assert without.arrived_s == 21.0


def test_a_closing_link_ends_a_waiting_read(link: Any) -> None:
    ended = threading.Event()

    def read() -> None:
        with pytest.raises(LinkLost):
            link.read(later(60.0))
        ended.set()

    thread = threading.Thread(target=read)
    thread.start()
    link.cancel()
    assert ended.wait(5.0)
    thread.join()


class Scripted(can.BusABC):
    """Bus that gives out a list of messages, one at a time, with pauses between them."""

    def __init__(self, *messages: can.Message) -> None:
        self.messages = [item for message in messages for item in (None, message)]
        super().__init__("scripted")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.messages.pop(0) if self.messages else None), False

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self._recv_internal(timeout)[0]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


def test_an_error_frame_does_not_end_the_wait_for_an_answer() -> None:
    answer = can.Message(arbitration_id=3, data=b"x", is_extended_id=False)
    link = CanLink(Scripted(can.Message(is_error_frame=True), can.Message(is_remote_frame=True), answer), "scripted")
    assert [frame.data for frame in FrameReader().feed(link.read(later(5.0)), now_s())] == [b"x"]
    link.close()


def test_an_adapter_that_is_away_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    opener, _ = can_opener(options(channel="nocan7"), "finger")
    with pytest.raises(DeviceUnavailable):
        opener()
    assert caplog.records == []


class Moody(can.BusABC):
    """Bus whose library raises errors of its own."""

    def __init__(self) -> None:
        super().__init__("moody")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        raise KeyError("handle")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise RuntimeError("no handle")

    def shutdown(self) -> None:
        super().shutdown()
        raise RuntimeError("no handle")


def test_whatever_a_library_raises_is_a_lost_link() -> None:
    link = CanLink(Moody(), "moody")
    with pytest.raises(LinkLost, match="handle"):
        link.read(later(0.1))
    with pytest.raises(LinkLost, match="no handle"):
        link.write(record(CanFrame(3, b"")), later(0.1))
    link.close()
    link.close()


def test_bytes_that_are_no_records_are_refused() -> None:
    with pytest.raises(Refused, match="older version"):
        list(FrameReader().feed(b"t1812AABB\r", 1.0))


@pytest.mark.parametrize("transport", ["serial", "virtual"])
def test_what_was_captured_is_replayed_with_its_time_stamps(transport: str, tmp_path: Path) -> None:
    path = tmp_path / "wire.jsonl"
    far_side = tfmini_i.start_can(ScriptedProximity(), {"transport": transport})
    with wired(far_side, "can:tfmini", {"capture": str(path)}) as device:
        first = device.newest(soon())
        device.newest(soon(), not_before_s=first.host_time_s + 0.2)
        recorded, _ = device.mailbox.since(0)
    with closing(connect(Context(name="again"), "can:tfmini", {"channel": "can0", "replay": str(path)})) as device:
        first = device.newest(soon())
        device.newest(soon(), not_before_s=first.host_time_s + 0.1)
        replayed, _ = device.mailbox.since(0)
    count = min(len(recorded), len(replayed))
    assert count > 5
    assert [s.value for s in replayed[:count]] == [s.value for s in recorded[:count]]
    assert [s.device_time_s for s in replayed[:count]] == [s.device_time_s for s in recorded[:count]]
