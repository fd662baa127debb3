"""Measurements of the RPLIDAR's standard scan: five bytes without a checksum (Slamtec interface protocol, LR001)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

NODE_BYTES = 5
IN_STEP = 8  # a shifted stream passes one test with probability 1/4, eight with 1/65536
FULL_TURN_Q6 = 360 * 64


def begins_node(data: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return, for every index in `data` except the last four, whether a plausible measurement begins there."""
    start, check = data[:-4] & 3, data[1:-3] & 1
    angle_q6 = data[1:-3].astype(np.int32) >> 1 | data[2:-2].astype(np.int32) << 7
    is_good: NDArray[np.bool_] = ((start == 1) | (start == 2)) & (check == 1) & (angle_q6 <= FULL_TURN_Q6)
    return is_good


def decode(nodes: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Return angles in radians and distances in metres (NaN for none) of (n, 5) measurements."""
    n = nodes.astype(np.int32)
    angle_rad = np.radians((n[:, 1] >> 1 | n[:, 2] << 7) / 64.0)
    distance_m = (n[:, 3] | n[:, 4] << 8) / 4000.0
    return angle_rad, np.where(distance_m > 0.0, distance_m, math.nan)


class NodeParser:
    """Parses measurements from bytes in chunks of any size; `None` in the result marks a misstep."""

    def __init__(self) -> None:
        self._buffer = b""
        self._is_in_step = False
        self.missteps = 0

    def feed(self, chunk: bytes) -> list[NDArray[np.uint8] | None]:
        """Return runs of (n, 5) measurements that are now confirmed, separated by missteps."""
        self._buffer += chunk
        runs: list[NDArray[np.uint8] | None] = []
        if len(self._buffer) < NODE_BYTES * (IN_STEP + 1):
            return runs
        data = np.frombuffer(self._buffer, np.uint8)
        good = begins_node(data)
        at = 0
        while True:
            steps = good[at::NODE_BYTES]
            length = len(steps) if steps.all() else int(np.argmin(steps))
            trusted = length - IN_STEP
            if trusted > 0:
                self._is_in_step = True
                runs.append(data[at : at + trusted * NODE_BYTES].reshape(-1, NODE_BYTES))
                at += trusted * NODE_BYTES
            if length == len(steps):
                break  # in step up to the end, but the last few are not confirmed yet
            if self._is_in_step:
                self.missteps += 1
                runs.append(None)
            self._is_in_step = False
            at = _next_in_step(good, at + 1)
        self._buffer = self._buffer[at:]
        return runs

    @property
    def pending(self) -> int:
        """Return the number of measurements received but not yet confirmed."""
        return len(self._buffer) // NODE_BYTES


def _next_in_step(good: NDArray[np.bool_], at: int) -> int:
    """Return the first index from `at` on after which all known bytes stay in step for the confirmation length."""
    span = NODE_BYTES * IN_STEP
    padded = np.concatenate((good[at:], np.ones(span, np.bool_)))  # bytes yet to come may still be good
    ok = padded[: len(good) - at].copy()
    for k in range(1, IN_STEP + 1):
        ok &= padded[k * NODE_BYTES : k * NODE_BYTES + len(ok)]
    places = np.flatnonzero(ok)
    return at + int(places[0]) if len(places) else len(good)
