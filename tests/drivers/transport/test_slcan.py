"""Tests of the slcan adapter: lines, time stamps, CAN FD, exclusive opening, and its use as an interface of python-can."""

import os
import struct
import time
from collections.abc import Iterator
from contextlib import closing

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.emulators.ports import PtyPort
from drivers.transport.can_frames import EXTENDED
from drivers.transport.slcan import INTERFACE, Line, LineReader, SlcanBus, _Stamps, line_of

ids = st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF).map(lambda id_: id_ | EXTENDED))
frames = st.tuples(ids, st.binary(max_size=8))


def line(id_: int, data: bytes) -> Line:
    return Line(ord("T" if id_ & EXTENDED else "t"), id_ & ~EXTENDED, len(data), data)


@given(st.lists(frames, max_size=6), st.integers(min_value=0))
def test_lines_survive_any_chunking(sent: list[tuple[int, bytes]], cut: int) -> None:
    reader = LineReader()
    data = b"z\r" + b"".join(line_of(id_, payload) for id_, payload in sent)
    at = cut % (len(data) + 1)
    assert reader.feed(data[:at]) + reader.feed(data[at:]) == [line(id_, payload) for id_, payload in sent]
    assert reader.bad == 0


def test_noise_and_a_false_header_before_a_line_cost_nothing() -> None:
    reader, sent = LineReader(), line_of(0x181, b"123456")
    assert reader.feed(b"\x00t9tt" + sent[:5] + sent) == [line(0x181, b"123456")]
    assert reader.bad == 0


@pytest.mark.parametrize(
    "damaged",
    [
        b"t1816270023\r",  # characters lost
        b"t18162700230000\r",  # characters added
        b"t1G12AABB\r",
        b"t 812AABB\r",
        b"t1_12AABB\r",
        b"t181+AABB\r",
        b"t1819AABBCCDDEEFF001122\r",
        b"T181\r",
        b"t\r",
    ],
)
def test_a_damaged_line_is_no_frame_and_no_error(damaged: bytes) -> None:
    reader = LineReader()
    assert reader.feed(damaged) == []
    assert reader.bad == 1


def test_a_line_whose_length_was_damaged_is_not_taken_for_a_shorter_one_with_a_time_stamp() -> None:
    reader, good = LineReader(), line_of(0x181, bytes(8))
    damaged = b"t1816" + good[5:]
    found = reader.feed(good + damaged + good)
    assert found == [line(0x181, bytes(8))] * 2
    assert reader.bad == 1


def test_time_stamps_that_are_switched_on_are_believed_after_some_lines() -> None:
    reader, stamped = LineReader(), b"t1812AABB1F40\r"
    assert reader.feed(line_of(0x181, b"\xaa\xbb")) == [line(0x181, b"\xaa\xbb")]
    found = reader.feed(stamped * 4)
    assert [frame.stamp_ms for frame in found] == [8000, 8000]


def test_the_adapters_clock_goes_on_over_its_minute_and_over_silence() -> None:
    stamps = _Stamps()
    arrived_s = [100.0, 100.5, 101.0, 281.0]
    got = [stamps.seconds(ms, at_s) for ms, at_s in zip((59_000, 59_500, 0, 0), arrived_s, strict=True)]
    assert got == pytest.approx(arrived_s)


@pytest.fixture
def port() -> Iterator[PtyPort]:
    with closing(PtyPort("slcan")) as port:
        yield port


def heard(port: PtyPort, end: bytes) -> bytes:
    data = b""
    give_up_s = time.monotonic() + 3.0
    while not data.endswith(end) and time.monotonic() < give_up_s:
        data += b"".join(chunk for _, chunk in port.receive(0.1))
    return data


def test_any_program_opens_it_through_python_can(port: PtyPort) -> None:
    with can.Bus(str(port.path), INTERFACE, bitrate=250_000) as bus:
        assert isinstance(bus, SlcanBus)
        assert heard(port, b"O\r") == b"\rC\rS5\rO\r"
        port.send(None, b"t1232AABB\rR1ABCDEF08\rt12X\r")
        first, second = bus.recv(1.0), bus.recv(1.0)
        assert first is not None and (first.arbitration_id, bytes(first.data)) == (0x123, b"\xaa\xbb")
        assert abs(first.timestamp - time.time()) < 10.0
        assert second is not None and second.is_remote_frame and second.is_extended_id and second.dlc == 8
        assert bus.recv(0.0) is None
        bus.send(second)
        bus.send(can.Message(arbitration_id=5, data=b"\x01", is_extended_id=False))
        assert heard(port, b"01\r") == b"R1ABCDEF08\rt005101\r"
    assert heard(port, b"C\r") == b"C\r"


def test_can_fd_frames_go_both_ways(port: PtyPort) -> None:
    with can.Bus(str(port.path), INTERFACE, fd=True, data_bitrate=5_000_000) as bus:
        assert heard(port, b"O\r") == b"\rC\rS8\rY5\rO\r"
        sent = can.Message(arbitration_id=7, data=bytes(10), is_fd=True, is_extended_id=False)
        bus.send(sent)
        assert heard(port, b"\r") == b"b0079" + 24 * b"0" + b"\r"
        port.send(None, b"d0079" + 24 * b"1" + b"\r")
        got = bus.recv(1.0)
        assert got is not None and got.is_fd and bytes(got.data) == 12 * b"\x11"


def test_a_second_program_cannot_open_it_and_is_told_who_has_it(port: PtyPort) -> None:
    with can.Bus(str(port.path), INTERFACE), pytest.raises(can.CanInitializationError, match=f"pid {os.getpid()}"):
        can.Bus(str(port.path), INTERFACE)


def test_arguments_that_the_adapter_does_not_have_are_refused(port: PtyPort) -> None:
    with pytest.raises(ValueError, match="bit rates"):
        can.Bus(str(port.path), INTERFACE, bitrate=83_333)


def test_a_port_that_is_gone_is_an_error_of_python_can(port: PtyPort) -> None:
    with can.Bus(str(port.path), INTERFACE) as bus:
        port.vanish()
        with pytest.raises(can.CanOperationError):
            bus.recv(1.0)


def test_python_cans_own_adapter_takes_our_lines(port: PtyPort) -> None:
    with can.Bus(str(port.path), "slcan", bitrate=250_000, sleep_after_open=0) as bus:
        port.send(None, line_of(0x181, struct.pack("<q", 7)) + line_of(9 | EXTENDED, b"x"))
        first, second = bus.recv(1.0), bus.recv(1.0)
    assert first is not None and (first.arbitration_id, first.is_extended_id) == (0x181, False)
    assert second is not None and (second.arbitration_id, second.is_extended_id, bytes(second.data)) == (9, True, b"x")
