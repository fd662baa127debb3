"""CAN frames, and the bytes in which a link hands them over and a capture keeps them, whatever the adapter.

A record is a mark, the number of data bytes, the adapter's time stamp (s; 0 without one), the identifier, and the data.
"""

from __future__ import annotations

import struct
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


def records(chunk: bytes) -> list[tuple[int, bytes, float]]:
    """Return identifier, data and the adapter's time stamp of each record.

    Raises:
        Refused: the bytes are not records.
    """
    found, at, end = [], 0, len(chunk)
    while at < end:
        if chunk[at] != MARK or at + HEAD.size > end:
            what = "these bytes are not CAN frames; the recording may be one of an older version"
            raise Refused(what, code=chunk[at], hint="make the recording again with this version")
        _, length, stamp_s, id_ = HEAD.unpack_from(chunk, at)
        data_at = at + HEAD.size
        at = data_at + length
        found.append((id_, chunk[data_at:at], stamp_s))
    return found


class FrameReader:
    """Reads records, and converts the time stamps of the adapter to the links' clock."""

    def __init__(self) -> None:
        self._time = HostTime()

    def reset(self) -> None:
        """Start again, because the link was reopened."""
        self._time.reset()

    def feed(self, chunk: bytes, arrived_s: float) -> list[CanFrame]:
        """Return the frames of a chunk that arrived at `arrived_s`; a frame with a time stamp may have arrived earlier."""
        host_s = self._time.host_s
        return [
            CanFrame(id_, data, host_s(device_s=stamp_s, arrived_s=arrived_s) if stamp_s else arrived_s)
            for id_, data, stamp_s in records(chunk)
        ]
