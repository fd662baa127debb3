"""Express scans of the RPLIDAR: capsules of 32 measurements under an exclusive or (Slamtec interface protocol, LR001).

A capsule says at which angle it starts; its measurements are spread evenly up to the start of the next one, each moved
back by an offset of its own. So a capsule can be decoded only when its successor has come.
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
UNEVEN = 0.3  # part by which the angles of two neighbours may differ: a motor's speed changes slowly
NO_RANGE = math.nan
Points = tuple[Array, Array]


def is_capsule(data: bytes) -> bool:
    """Do sync nibbles and exclusive or of these 84 bytes fit?"""
    return data[0] >> 4 == 0xA and data[1] >> 4 == 0x5 and (data[0] & 15 | (data[1] & 15) << 4) == xor_byte(data[2:])


def start_rad(capsule: bytes) -> float:
    """Angle of its first measurement, before the offset."""
    return math.radians((struct.unpack_from("<H", capsule, 2)[0] & 0x7FFF) / 64.0)


def is_first(capsule: bytes) -> bool:
    """Did the scan begin anew with it?"""
    return bool(capsule[3] & 0x80)


def decode_capsule(capsule: bytes, next_start_rad: float) -> Points:
    """Angles in radians within one turn and distances in metres (NaN for none) of a capsule's 32 measurements:

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
    """Measurements out of bytes in any chunks; `None` in the result stands for lost bytes."""

    def __init__(self) -> None:
        self._buffer = b""
        self._before: bytes | None = None
        self._span_rad: float | None = None
        self.missteps = 0

    def feed(self, chunk: bytes) -> list[Points | None]:
        """The measurements of each capsule whose successor has come."""
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
        """Measurements that wait for the next capsule."""
        return 0 if self._before is None else POINTS

    def _follow(self, capsule: bytes) -> list[Points | None]:
        """What the arrival of a capsule tells of the one before; capsules of unequal span are no neighbours."""
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
    """Places where a new turn begins: the angle falls by more than half a turn.

    Args:
        last_rad: the angle before the first.
    """
    fall_rad = -np.diff(angle_rad, prepend=last_rad)
    return [int(place) for place in np.flatnonzero(fall_rad > math.pi)]
