"""Frames of SICK CoLa and UFACTORY xArm, which have no driver, to test the framer with two more protocols."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from drivers.transport.checks import xor_byte
from drivers.transport.framing import Framer

COLA_B_START = b"\x02" * 4
COLA_B_HEAD = 8
XARM_PROTOCOL = 2
LONGEST = 65_536


def cola_a(text: str) -> bytes:
    """Return a frame `02 text 03` (SICK LMS4xxx telegram listing, p 52)."""
    return b"\x02" + text.encode("ascii") + b"\x03"


def decode_cola_a(frame: bytes) -> str:
    """Return the text between the start and end marks.

    Raises:
        ValueError: a mark is missing.
    """
    if len(frame) < 2 or frame[0] != 2 or frame[-1] != 3:
        raise ValueError("a CoLa A telegram stands between 02 and 03")
    return frame[1:-1].decode("ascii")


def cola_b(payload: bytes) -> bytes:
    """Return a frame `02020202 length32 payload xor` (big-endian; SICK LMS4xxx telegram listing, p 55)."""
    return COLA_B_START + struct.pack(">I", len(payload)) + payload + bytes([xor_byte(payload)])


def cola_b_framer() -> Framer:
    """Return a framer for CoLa B telegrams."""
    return Framer(COLA_B_START, _cola_b_length, lambda f: xor_byte(f[COLA_B_HEAD:-1]) == f[-1])


def _cola_b_length(data: bytes) -> int | None:
    if len(data) < COLA_B_HEAD:
        return None
    length = int.from_bytes(data[4:COLA_B_HEAD], "big")
    return COLA_B_HEAD + length + 1 if 1 <= length <= LONGEST else 0


@dataclass(frozen=True, slots=True)
class XarmFrame:
    """xArm frame `tid16 0002 len16 register [state] parameters`; only answers have a state."""

    tid: int
    register: int
    state: int | None
    parameters: bytes

    @property
    def is_unable_to_move(self) -> bool:
        """State bit 4."""
        return bool((self.state or 0) & 0x10)


def xarm(tid: int, register: int, parameters: bytes = b"") -> bytes:
    """Return a request (docs.ufactory.cc, private Modbus TCP)."""
    return struct.pack(">HHHB", tid, XARM_PROTOCOL, 1 + len(parameters), register) + parameters


def decode_xarm(frame: bytes, *, is_answer: bool) -> XarmFrame:
    """Decode a complete frame.

    Raises:
        ValueError: the frame has another protocol, or the length does not fit.
    """
    tid, protocol, length, register = struct.unpack_from(">HHHB", frame)
    if protocol != XARM_PROTOCOL or length != len(frame) - 6:
        raise ValueError("not an xArm frame")
    rest = frame[7:]
    return XarmFrame(tid, register, rest[0] if is_answer else None, rest[1:] if is_answer else rest)
