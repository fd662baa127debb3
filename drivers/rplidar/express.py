"""Express scans of the RPLIDAR: capsules of 32 measurements with an XOR checksum (Slamtec interface protocol, LR001).

A capsule states its start angle; its measurements are spread evenly up to the start of the next capsule, each minus an
offset of its own. A capsule can therefore be decoded only after the next one has arrived.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from drivers.transport.checks import xor_byte
from hal.arrays import Array

EXPRESS_SCAN, EXPRESS_TYPE = 0x82, 0x82
REQUEST_BODY = bytes([0xA5, EXPRESS_SCAN, 5, 0, 0, 0, 0, 0])
REQUEST = REQUEST_BODY + bytes([xor_byte(REQUEST_BODY)])
CAPSULE_BYTES, POINTS = 84, 32
CABIN = np.dtype([("d1", "<u2"), ("d2", "<u2"), ("offsets", "u1")])
UNEVEN = 0.3  # fraction by which the spans of neighbours may differ: a motor's speed changes slowly
NO_RANGE = math.nan
Points = tuple[Array, Array]


def is_capsule(data: bytes) -> bool:
    """Return whether the sync nibbles and the XOR checksum of these 84 bytes are right."""
    return data[0] >> 4 == 0xA and data[1] >> 4 == 0x5 and (data[0] & 15 | (data[1] & 15) << 4) == xor_byte(data[2:])


def start_rad(capsule: bytes) -> float:
    """Return the angle of the first measurement, before its offset."""
    return math.radians((struct.unpack_from("<H", capsule, 2)[0] & 0x7FFF) / 64.0)


def is_first(capsule: bytes) -> bool:
    """Return whether a new scan begins with this capsule."""
    return bool(capsule[3] & 0x80)


def decode_capsule(capsule: bytes, next_start_rad: float) -> Points:
    """Return angles in radians within one turn, and distances in metres (NaN for none), of the 32 measurements.

    angle_k = start + k / 32 (next start - start) - offset_k.
    """
    cabins = np.frombuffer(capsule, CABIN, POINTS // 2, 4)
    raw = np.stack([cabins["d1"], cabins["d2"]], axis=1).ravel().astype(np.int64)
    nibbles = np.stack([cabins["offsets"] & 15, cabins["offsets"] >> 4], axis=1).ravel().astype(np.int64)
    offset_rad = np.radians((nibbles | (raw & 3) << 4) / 8.0)
    start = start_rad(capsule)
    step_rad = (next_start_rad - start) % math.tau / POINTS
    angle_rad = np.asarray((start + np.arange(POINTS) * step_rad - offset_rad) % math.tau, np.float64)
    distance_m = (raw >> 2) / 1000.0
    return angle_rad, np.where(distance_m > 0.0, distance_m, NO_RANGE)


class CapsuleParser:
    """Parses measurements from bytes in chunks of any size; `None` in the result marks lost bytes."""

    def __init__(self) -> None:
        self._buffer = b""
        self._before: bytes | None = None
        self._span_rad: float | None = None
        self.missteps = 0

    def feed(self, chunk: bytes) -> list[Points | None]:
        """Return the measurements of each capsule whose successor has arrived."""
        data, at, found = self._buffer + chunk, 0, list[Points | None]()
        while at + CAPSULE_BYTES <= len(data):
            capsule = data[at : at + CAPSULE_BYTES]
            if not is_capsule(capsule):
                found += self._misstep() if self._before is not None else []
                at += 1
                continue
            found += self._follow(capsule)
            at += CAPSULE_BYTES
        self._buffer = data[at:]
        return found

    @property
    def pending(self) -> int:
        """Return the number of measurements that wait for the next capsule."""
        return 0 if self._before is None else POINTS

    def _follow(self, capsule: bytes) -> list[Points | None]:
        """Decode the previous capsule from the arrival of this one; capsules of unequal span are not neighbours."""
        before, self._before = self._before, capsule
        if before is None or is_first(capsule):
            self._span_rad = None
            return []
        last_rad, self._span_rad = self._span_rad, (start_rad(capsule) - start_rad(before)) % math.tau
        if last_rad is None:
            return []
        if abs(self._span_rad - last_rad) > UNEVEN * last_rad:
            self.missteps += 1
            return [None]
        return [decode_capsule(before, start_rad(capsule))]

    def _misstep(self) -> list[Points | None]:
        self.missteps += 1
        self._before = self._span_rad = None
        return [None]


def split_turns(angle_rad: Array, last_rad: float) -> list[int]:
    """Return the indices where a new turn begins: the angle falls by more than half a turn.

    Args:
        last_rad: the angle before the first one, in radians.
    """
    fall_rad = -np.diff(angle_rad, prepend=last_rad)
    return [int(place) for place in np.flatnonzero(fall_rad > math.pi)]
