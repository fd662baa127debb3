"""CAN frames, and the bytes in which a link hands them over and a capture keeps them, whatever the adapter.

A record is a mark, the number of data bytes, the adapter's time stamp (s; 0 without one), the identifier, and the data.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from drivers.transport.link import Refused
from drivers.transport.timebase import HostTime

HEAD = struct.Struct("<BBdI")
MARK = 0xC1
EXTENDED = 1 << 31  # flag of a 29-bit identifier, as in linux/can.h
LONGEST_CLASSIC = 8


class CanFrame(NamedTuple):
    """CAN frame; more than eight data bytes make it a CAN FD frame.

    Attributes:
        id: 11-bit identifier, or a 29-bit one with the flag `EXTENDED`.
        arrived_s: when the frame arrived, on the links' clock; 0 for a frame to send.
    """

    id: int
    data: bytes
    arrived_s: float = 0.0


def record(frame: CanFrame, stamp_s: float = 0.0) -> bytes:
    """Return a frame as a record."""
    return HEAD.pack(MARK, len(frame.data), stamp_s, frame.id) + frame.data


def records(chunk: bytes) -> Iterator[tuple[int, bytes, float]]:
    """Yield identifier, data and the adapter's time stamp of each record.

    Raises:
        Refused: the bytes are not records.
    """
    at = 0
    while at < len(chunk):
        if chunk[at] != MARK or at + HEAD.size > len(chunk):
            what = "these bytes are not CAN frames; the recording may be one of an older version"
            raise Refused(what, code=chunk[at], hint="make the recording again with this version")
        _, length, stamp_s, id_ = HEAD.unpack_from(chunk, at)
        at += HEAD.size + length
        yield id_, chunk[at - length : at], stamp_s


class FrameReader:
    """Reads records, and converts the time stamps of the adapter to the links' clock."""

    def __init__(self) -> None:
        self._time = HostTime()

    def reset(self) -> None:
        """Start again, because the link was reopened."""
        self._time.reset()

    def feed(self, chunk: bytes, arrived_s: float) -> Iterator[CanFrame]:
        """Yield the frames of a chunk that arrived at `arrived_s`; a frame with a time stamp may have arrived earlier."""
        for id_, data, stamp_s in records(chunk):
            at_s = self._time.host_s(device_s=stamp_s, arrived_s=arrived_s) if stamp_s else arrived_s
            yield CanFrame(id_, data, at_s)
