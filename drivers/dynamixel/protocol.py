"""Dynamixel protocol 2.0: packets with byte stuffing and CRC (ROBOTIS e-Manual, protocol 2.0)."""

from __future__ import annotations

import struct
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

from drivers.transport.checks import crc_dynamixel
from drivers.transport.framing import Framer

HEADER = b"\xff\xff\xfd\x00"
STUFF, STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
PING, READ, WRITE, REBOOT, STATUS = 0x01, 0x02, 0x03, 0x08, 0x55
SYNC_READ, SYNC_WRITE, BULK_READ, FAST_SYNC_READ = 0x82, 0x83, 0x92, 0x8A
BROADCAST = 0xFE
ALERT = 0x80
SHORTEST, LONGEST = 3, 1024
ERRORS = {
    1: "failed",
    2: "instruction unknown",
    3: "CRC wrong",
    4: "out of range",
    5: "length",
    6: "limit",
    7: "access",
}


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet without stuffing: who, what, and what follows."""

    id: int
    instruction: int
    parameters: bytes


def encode(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """A whole packet; length and CRC are taken after stuffing."""
    body = (bytes([instruction]) + parameters).replace(STUFF, STUFFED)
    head = HEADER + bytes([id_]) + struct.pack("<H", len(body) + 2) + body
    return head + struct.pack("<H", crc_dynamixel(head))


def decode(frame: bytes) -> Packet:
    """The packet of a checked frame."""
    body = frame[7:-2].replace(STUFFED, STUFF)
    return Packet(frame[4], body[0], body[1:])


def framer(fast_sizes: Container[int] | None = None) -> Framer:
    """Packets out of bytes: header, length in bounds, CRC.

    A header inside a packet is stuffed, so one that stands there begins another: the first was a false one, and does not
    make true ones wait for the bytes that it promises. Answers to fast sync reads are not stuffed; of them the length is
    known.

    Args:
        fast_sizes: how many bytes of parameters such an answer may have; any number unless given.
    """

    def length(data: bytes) -> int | None:
        if len(data) < 8:
            return None
        size = 7 + (data[5] | data[6] << 8)
        if not 7 + SHORTEST <= size <= 7 + LONGEST:
            return 0
        if data[4] == BROADCAST and data[7] == STATUS:
            return size if fast_sizes is None or size - 8 in fast_sizes else 0
        return 0 if 0 <= data.find(HEADER, 4) < size else size

    return Framer(HEADER, length, lambda f: crc_dynamixel(f[:-2]) == f[-2] | f[-1] << 8)


def sync_read(address: int, length: int, ids: Sequence[int], *, fast: bool = False) -> bytes:
    """Read the same block of several servos."""
    instruction = FAST_SYNC_READ if fast else SYNC_READ
    return encode(BROADCAST, instruction, struct.pack("<HH", address, length) + bytes(ids))


def sync_write(address: int, length: int, values: Mapping[int, bytes]) -> bytes:
    """Write a block of each of several servos; nobody answers."""
    items = b"".join(bytes([id_]) + data for id_, data in values.items())
    return encode(BROADCAST, SYNC_WRITE, struct.pack("<HH", address, length) + items)


def bulk_read(items: Sequence[tuple[int, int, int]]) -> bytes:
    """Read `(id, address, length)` of several servos."""
    return encode(BROADCAST, BULK_READ, b"".join(struct.pack("<BHH", *item) for item in items))


def write(id_: int, address: int, data: bytes) -> bytes:
    """Write a block of one servo."""
    return encode(id_, WRITE, struct.pack("<H", address) + data)


def read(id_: int, address: int, length: int) -> bytes:
    """Read a block of one servo."""
    return encode(id_, READ, struct.pack("<HH", address, length))
