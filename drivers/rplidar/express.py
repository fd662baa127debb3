"""Express scans of the RPLIDAR: capsules of 32 measurements with an XOR checksum (Slamtec interface protocol, LR001).

A capsule states its start angle; its measurements are spread evenly up to the start of the next capsule, each minus an
offset of its own. A capsule can therefore be decoded only after the next one has arrived.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from itertools import pairwise

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
Points = tuple[Array, Array, Array]
REMEMBERED = 6  # spans; two of them that agree were of neighbours, even if every third capsule is lost


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
    """Return the 32 measurements: angles without and with their offsets, in radians within one turn, and distances.

    Distances are in metres, NaN for none.

    angle_k = start + k / 32 (next start - start) - offset_k.
    """
    cabins = np.frombuffer(capsule, CABIN, POINTS // 2, 4)
    raw = np.stack([cabins["d1"], cabins["d2"]], axis=1).ravel().astype(np.int64)
    nibbles = np.stack([cabins["offsets"] & 15, cabins["offsets"] >> 4], axis=1).ravel().astype(np.int64)
    offset_rad = np.radians((nibbles | (raw & 3) << 4) / 8.0)
    start = start_rad(capsule)
    step_rad = (next_start_rad - start) % math.tau / POINTS
    head_rad = np.asarray(start + np.arange(POINTS) * step_rad, np.float64)
    distance_m = (raw >> 2) / 1000.0
    return (
        head_rad % math.tau,
        (head_rad - offset_rad) % math.tau,
        np.where(distance_m > 0.0, distance_m, NO_RANGE),
    )


class CapsuleParser:
    """Parses measurements from bytes in chunks of any size; `None` in the result marks lost bytes."""

    def __init__(self) -> None:
        self._buffer = b""
        self._before: bytes | None = None
        self._spans_rad: deque[float] = deque(maxlen=REMEMBERED)
        self.missteps = 0

    def feed(self, chunk: bytes) -> list[Points | None]:
        """Return the measurements of each capsule whose successor has arrived."""
        data, at, found = self._buffer + chunk, 0, list[Points | None]()
        while at + CAPSULE_BYTES <= len(data):
            capsule = data[at : at + CAPSULE_BYTES]
            if not is_capsule(capsule):
                if (before := self._before) is not None and (begin := overlapping(before, data[at:])):
                    found.append(None)
                    self.missteps += 1
                    self._before, data, at = None, before + data[at:], begin
                    continue
                found += self._misstep() if before is not None else []
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
        """Decode the previous capsule; when the next one was lost, by the usual span, because the motor is steady."""
        before, self._before = self._before, capsule
        if is_first(capsule):
            self._spans_rad.clear()
            return []
        if before is None or capsule == before:
            return []
        span_rad = (start_rad(capsule) - start_rad(before)) % math.tau
        self._spans_rad.append(span_rad)
        usual_rad = self._usual_rad()
        if usual_rad is None:
            self.missteps += len(self._spans_rad) > 1
            return [None] if len(self._spans_rad) > 1 else []
        if is_near(span_rad, usual_rad):
            return [decode_capsule(before, start_rad(capsule))]
        self.missteps += 1
        return [decode_capsule(before, start_rad(before) + usual_rad), None]

    def _usual_rad(self) -> float | None:
        """Return the smallest recent span that has a like, or None before there is one."""
        spans_rad = sorted(self._spans_rad)
        return next((a for a, b in pairwise(spans_rad) if is_near(b, a)), None)

    def _misstep(self) -> list[Points | None]:
        self.missteps += 1
        before, self._before = self._before, None
        usual_rad = self._usual_rad()
        if before is None or usual_rad is None:
            return [None]
        return [decode_capsule(before, start_rad(before) + usual_rad), None]


def overlapping(capsule: bytes, rest: bytes) -> int:
    """Return where in a capsule another one begins that extends into the bytes after it; 0 if none does.

    Noise that ends in the head of a capsule passes the eight-bit checksum together with the first bytes of the true one
    once in 256 times; then the true one begins within it, and what follows is none.
    """
    data = capsule + rest[: CAPSULE_BYTES - 1]
    begins = (begin for begin in range(1, len(capsule)) if is_capsule(data[begin : begin + CAPSULE_BYTES]))
    return next(begins, 0)


def is_near(span_rad: float, usual_rad: float) -> bool:
    """Return whether two spans are those of neighbours."""
    return abs(span_rad - usual_rad) <= UNEVEN * usual_rad
