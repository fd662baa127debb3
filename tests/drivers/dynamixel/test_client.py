"""The Dynamixel client never takes a late answer for the answer to another request."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.dynamixel import protocol
from drivers.dynamixel.client import DynamixelClient
from drivers.transport.checks import crc_dynamixel
from drivers.transport.link import Link, NoAnswer, Refused, now_s

IDS = (1, 2, 3, 4, 5, 6)
Fate = Callable[[int, bytes], list[tuple[int, bytes]]]
"""Splits the answer to request number n into pieces, each arriving after a number of further requests."""


class Bus:
    """Servos whose registers all contain the number of the request; some answers come late."""

    name, byte_s = "bus", 0.0

    def __init__(self, fate: Fate) -> None:
        self.asked: list[protocol.Packet] = []
        self._fate = fate
        self._coming: list[tuple[int, bytes]] = []
        self._framer = protocol.framer()

    def write(self, data: bytes, until_s: float) -> None:
        for frame in self._framer.feed(data):
            self.asked.append(packet := protocol.decode(frame))
            number = len(self.asked)
            self._coming += [(number + later, piece) for later, piece in self._fate(number, answer(packet, number))]

    def read(self, until_s: float) -> bytes:
        due = [piece for number, piece in self._coming if number <= len(self.asked)]
        self._coming = [item for item in self._coming if item[0] > len(self.asked)]
        return b"".join(due)

    def is_present(self) -> bool:
        return True

    def close(self) -> None: ...


def answer(packet: protocol.Packet, number: int) -> bytes:
    _, length = struct.unpack_from("<HH", packet.parameters)
    block = bytes([number]) * length
    if packet.instruction == protocol.READ:
        return protocol.encode(packet.id, protocol.STATUS, b"\0" + block)
    ids = packet.parameters[4:]
    if packet.instruction == protocol.SYNC_READ:
        return b"".join(protocol.encode(id_, protocol.STATUS, b"\0" + block) for id_ in ids)
    frame = protocol.HEADER + struct.pack("<BHB", protocol.BROADCAST, 1 + len(ids) * (4 + length), protocol.STATUS)
    for id_ in ids:
        frame += bytes([0, id_]) + block
        frame += struct.pack("<H", crc_dynamixel(frame))
    return frame


def client_of(fate: Fate) -> tuple[Bus, DynamixelClient]:
    bus = Bus(fate)
    return bus, DynamixelClient(cast(Link, bus), timeout_s=0.002, is_clear=True)


def soon() -> float:
    return now_s() + 0.05


@given(st.lists(st.sampled_from([0, 0, 1, 2, None]), min_size=8, max_size=40))
def test_no_answer_is_older_than_its_question(late: list[int | None]) -> None:
    """Each answer is late by some requests or lost, in order or not."""

    def fate(number: int, whole: bytes) -> list[tuple[int, bytes]]:
        later = late[number % len(late)]
        return [] if later is None else [(later, whole)]

    bus, client = client_of(fate)
    for _ in range(12):
        try:
            blocks = client.fast_sync_read(IDS, 126, 10, now_s() + 0.004)
        except NoAnswer:
            continue
        assert {block[0] for block in blocks.values()} == {len(bus.asked)}
        assert list(blocks) == list(IDS)


@given(st.lists(st.sampled_from([0, 0, 0, 1, 2, None]), min_size=8, max_size=40))
def test_no_late_answer_of_one_servo_is_taken_on_a_bus_that_keeps_order(late: list[int | None]) -> None:
    due = 0

    def fate(number: int, whole: bytes) -> list[tuple[int, bytes]]:
        nonlocal due
        later = late[number % len(late)]
        if later is None:
            return []
        due = max(due, number + later)  # never before an earlier answer
        return [(due - number, whole)]

    bus, client = client_of(fate)
    for _ in range(12):
        try:
            block = client.read(2, 120, 16, now_s() + 0.004)
        except NoAnswer:
            continue
        assert block[0] == len(bus.asked)


def test_the_first_answer_of_a_session_was_asked_for_in_it() -> None:
    """The port was opened again while an answer of the session before was still on its way."""
    old = protocol.encode(2, protocol.STATUS, bytes(11))
    bus = Bus(lambda number, whole: [(0, old * (number == 1) + whole)])
    client = DynamixelClient(cast(Link, bus), timeout_s=0.002)
    assert client.read(2, 126, 10, soon()) == bytes([2]) * 10
    assert client.read(2, 126, 10, soon()) == bytes([3]) * 10
    assert len(bus.asked) == 3  # the first was a probe


def test_an_answer_given_twice_counts_once() -> None:
    bus, client = client_of(lambda _, whole: [(0, whole), (1, whole)])
    for _ in range(5):
        assert client.fast_sync_read(IDS, 126, 10, soon())[1][0] == len(bus.asked)


def test_halves_that_come_apart_are_one_answer_however_late_the_second_is() -> None:
    bus, client = client_of(lambda n, whole: [(0, whole[:9]), (n == 1, whole[9:])])
    assert client.read(1, 11, 1, soon()) == b"\x03"  # one lost, one probe, one good
    assert [x.parameters for x in bus.asked] == [b"\x0b\0\x01\0", b"\0\0\x02\0", b"\x0b\0\x01\0"]


@pytest.mark.parametrize("false", [b"\xff\xff\xfd\x00\x01\x00\x03\x55", b"\xff\xff\xfd\x00\xfe\x00\x03\x55"])
def test_a_false_header_makes_no_answer_wait_for_the_bytes_it_promises(false: bytes) -> None:
    bus, client = client_of(lambda _, whole: [(0, false + b"noise" + whole)])
    client.read(1, 132, 4, now_s() + 0.0005)
    client.fast_sync_read(IDS, 126, 10, now_s() + 0.0005)
    assert len(bus.asked) == 2


class SlowLine(Bus):
    """At 1 ms per byte, a read that waits for less receives nothing."""

    byte_s = 0.001

    def read(self, until_s: float) -> bytes:
        return super().read(until_s) if until_s - now_s() > 0.03 else b""


def test_an_answer_has_the_time_that_its_bytes_take_on_the_line() -> None:
    client = DynamixelClient(cast(Link, SlowLine(lambda _, whole: [(0, whole)])), timeout_s=0.002, is_clear=True)
    assert client.fast_sync_read(IDS, 126, 10, client.until_s(1, 150))[6][0] == 1


def test_packets_that_fit_nothing_are_told() -> None:
    other = protocol.encode(9, protocol.STATUS, b"\0\x01\x02")
    _, client = client_of(lambda _n, _whole: [(0, other)])
    with pytest.raises(NoAnswer, match=r"servo 1 does not answer; servo 9 sent 3 bytes"):
        client.read(1, 132, 4, now_s() + 0.0005)


def test_an_error_report_in_place_of_an_answer_is_raised_at_once() -> None:
    report = protocol.encode(2, protocol.STATUS, b"\x02")
    bus, client = client_of(lambda n, whole: [(0, report if n == 1 else whole)])
    with pytest.raises(Refused, match=r"servo 2: error 2 \(instruction unknown\)"):
        client.fast_sync_read(IDS, 126, 10, soon())
    assert len(client.fast_sync_read(IDS, 126, 10, soon())) == 6
    assert len(bus.asked) == 2


def test_a_bus_that_is_silent_for_long_is_asked_less_and_less() -> None:
    bus, client = client_of(lambda _n, _whole: [])
    for _ in range(50):
        with pytest.raises(NoAnswer):
            client.fast_sync_read(IDS, 126, 10, now_s() + 0.004)
    assert len(bus.asked) < 25
