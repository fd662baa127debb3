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
    """Packet without stuffing: id, instruction and parameters."""

    id: int
    instruction: int
    parameters: bytes


def encode(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a complete packet; length and CRC are computed after stuffing."""
    body = (bytes([instruction]) + parameters).replace(STUFF, STUFFED)
    head = HEADER + bytes([id_]) + struct.pack("<H", len(body) + 2) + body
    return head + struct.pack("<H", crc_dynamixel(head))


def decode(frame: bytes) -> Packet:
    """Return the packet of a checked frame."""
    body = frame[7:-2].replace(STUFFED, STUFF)
    return Packet(frame[4], body[0], body[1:])


def framer(fast_sizes: Container[int] | None = None) -> Framer:
    """Return a framer for packets: header, length within bounds, CRC.

    A header inside a packet is stuffed, so an unstuffed one begins another packet: the first header was false, and the
    framer does not wait for the rest of that frame. Answers to fast sync reads are not stuffed, so their length must be
    known.

    Args:
        fast_sizes: possible parameter sizes of such an answer, in bytes; any size unless given.
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
    """Return a request that reads the same block from several servos."""
    instruction = FAST_SYNC_READ if fast else SYNC_READ
    return encode(BROADCAST, instruction, struct.pack("<HH", address, length) + bytes(ids))


def sync_write(address: int, length: int, values: Mapping[int, bytes]) -> bytes:
    """Return a request that writes a block to each of several servos, without acknowledgement."""
    items = b"".join(bytes([id_]) + data for id_, data in values.items())
    return encode(BROADCAST, SYNC_WRITE, struct.pack("<HH", address, length) + items)


def bulk_read(items: Sequence[tuple[int, int, int]]) -> bytes:
    """Return a request that reads `(id, address, length)` from several servos."""
    return encode(BROADCAST, BULK_READ, b"".join(struct.pack("<BHH", *item) for item in items))


def write(id_: int, address: int, data: bytes) -> bytes:
    """Return a request that writes a block to one servo."""
    return encode(id_, WRITE, struct.pack("<H", address) + data)


def read(id_: int, address: int, length: int) -> bytes:
    """Return a request that reads a block from one servo."""
    return encode(id_, READ, struct.pack("<HH", address, length))
