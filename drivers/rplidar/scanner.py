"""Slamtec RPLIDAR A1/A2 over serial, standard and express scans (Slamtec interface protocol, LR001).

A measurement of a standard scan has five bytes and no checksum, only a start bit next to its inverse and one bit that
is always 1. A measurement is therefore accepted only when the next eight are in step too, and a turn with a misstep in
it is discarded as a whole.
"""

from __future__ import annotations

import math
import struct
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.line_scanners import Beams, LineScanner, within
from drivers.rplidar.express import CAPSULE_BYTES, EXPRESS_TYPE, REQUEST, CapsuleParser, Points, split_turns
from drivers.transport.capture import inside
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.serial_link import SerialLink
from hal.arrays import Array
from hal.readings import Quality
from hal.registry import Context, takes

STOP, RESET, START_SCAN, GET_INFO, GET_HEALTH = 0x25, 0x40, 0x20, 0x50, 0x52
INFO_TYPE, HEALTH_TYPE, SCAN_TYPE = 0x04, 0x06, 0x81
NODE_BYTES = 5
IN_STEP = 8  # a shifted stream passes one test with probability 1/4, eight with 1/65536
FULL_TURN_Q6 = 360 * 64
WHOLE_TURN_RAD = math.radians(330)  # a turn that lost its beginning is not published
JITTER_RAD = math.radians(2.0)
WARNING, ERROR = 1, 2
ANSWER_S = (0.3, 0.6, 0.9)  # of each attempt: a slow scanner catches up on repeated requests
RESET_S = 0.5
SPIN_UP_S = 2.5  # before the first measurement
TURN_S = 3.0  # restart when measurements arrive but no whole turn for this long
CONNECT_S = 6.0
SEND_S, QUIET_S = 0.3, 0.3
OLD_FIRMWARE = '; the oldest A1 models do not support express scans: for them set mode = "standard"'


class RplidarOptions(SerialOptions):
    """Options of `serial:rplidar`; a turn is sorted into `beams` equal sectors, the nearest measurement of each.

    `express` scans are protected by a checksum; the first A1 models do not support them.
    """

    mode: Annotated[
        Literal["standard", "express"],
        Field(description="`express` scans have a check sum; the first A1 models have only `standard`"),
    ] = "standard"
    beams: Annotated[
        int, Field(ge=90, le=3600, description="equal sectors of a turn, each with its nearest measurement")
    ] = 360
    scan_rate_hz: Annotated[float, Field(gt=0, le=20, description="turns per second, as set at the motor")] = 5.5
    min_range_m: Annotated[float, Field(ge=0, description="a smaller distance has no value")] = 0.15
    max_range_m: Annotated[float, Field(gt=0, description="a larger distance has no value")] = 12.0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one distance, one sigma")] = 0.01


def descriptor(length: int, mode: int, kind: int) -> bytes:
    """Return the descriptor: `A5 5A`, 30 bits of length and 2 of mode, type."""
    return struct.pack("<BBIB", 0xA5, 0x5A, length | mode << 30, kind)


def begins_node(data: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return, for every index in `data` except the last four, whether a plausible measurement begins there."""
    start, check = data[:-4] & 3, data[1:-3] & 1
    angle_q6 = data[1:-3].astype(np.int32) >> 1 | data[2:-2].astype(np.int32) << 7
    is_good: NDArray[np.bool_] = ((start == 1) | (start == 2)) & (check == 1) & (angle_q6 <= FULL_TURN_Q6)
    return is_good


def decode(nodes: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return start flags, angles in radians and distances in metres (NaN for none) of (n, 5) measurements."""
    n = nodes.astype(np.int32)
    angle_rad = np.radians((n[:, 1] >> 1 | n[:, 2] << 7) / 64.0)
    distance_m = (n[:, 3] | n[:, 4] << 8) / 4000.0
    return (n[:, 0] & 1).astype(bool), angle_rad, np.where(distance_m > 0.0, distance_m, math.nan)


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


class Rplidar(LineScanner):
    """Slamtec RPLIDAR scanner."""

    def __init__(self, context: Context, options: RplidarOptions) -> None:
        opener, name = serial_opener(options, context.name)
        scan_s = 1.0 / options.scan_rate_hz
        super().__init__(
            context, open_link=opener, link_name=name, max_age_s=3 * scan_s, silence_s=max(1.0, 4 * scan_s)
        )
        self.beams = Beams(
            count=options.beams,
            first_rad=0.0,
            step_rad=math.tau / options.beams,
            min_range_m=options.min_range_m,
            max_range_m=options.max_range_m,
            scan_s=scan_s,
        )
        self.sigma_m = options.sigma_m
        self._is_express = options.mode == "express"
        self._nodes, self._capsules = NodeParser(), CapsuleParser()
        self._turn: list[Points] | None = None
        self._turn_s = now_s()
        # The present turn: arrival time of its first chunk, and the number of measurements in that chunk.
        self._begun: tuple[float, int] | None = None
        self._measurement_s = 0.0
        self._last_rad = 0.0
        self._missed = 0
        self._quality = Quality.VALID

    def set_up(self, link: Link) -> None:
        """Set up as any stream, then allow time for the motor to spin up."""
        super().set_up(link)
        self._heard_s += SPIN_UP_S

    def start(self, link: Link) -> None:
        """Start the motor, stop scanning, identify, check the health (with one reset if bad), and start the scan."""
        if (line := inside(link, SerialLink)) is not None:
            line.set_dtr(False)  # the motor of an A1 turns while DTR is low
        link.write(bytes([0xA5, STOP]), now_s() + SEND_S)
        drain_until_quiet(link, quiet_s=0.02, until_s=now_s() + QUIET_S)
        self._ask(link, bytes([0xA5, GET_INFO]), descriptor(20, 0, INFO_TYPE), 20)
        status, _ = self._health(link)
        if status == ERROR:
            link.write(bytes([0xA5, RESET]), now_s() + SEND_S)
            drain_until_quiet(link, quiet_s=0.1, until_s=now_s() + RESET_S)
            status, code = self._health(link)
            if status == ERROR:
                raise Refused(f"the scanner reports error {code:04X}h, which a reset did not clear", code=code)
        self._quality = Quality.DEGRADED if status == WARNING else Quality.VALID
        self._nodes, self._capsules, self._turn, self._begun = NodeParser(), CapsuleParser(), None, None
        self._turn_s = now_s() + SPIN_UP_S
        if self._is_express:
            rest = self._ask(link, REQUEST, descriptor(CAPSULE_BYTES, 1, EXPRESS_TYPE), 0, OLD_FIRMWARE)
        else:
            rest = self._ask(link, bytes([0xA5, START_SCAN]), descriptor(5, 1, SCAN_TYPE), 0)
        self.receive(rest, now_s())

    def _health(self, link: Link) -> tuple[int, int]:
        """Return health status and error code."""
        answer = self._ask(link, bytes([0xA5, GET_HEALTH]), descriptor(3, 0, HEALTH_TYPE), 3)
        return answer[0], answer[1] | answer[2] << 8

    def _ask(self, link: Link, request: bytes, head: bytes, length: int, remedy: str = "") -> bytes:
        """Return what follows the descriptor `head`: at least `length` bytes."""
        for answer_s in ANSWER_S:
            link.write(request, now_s() + SEND_S)
            seen, until_s = b"", now_s() + answer_s
            while chunk := link.read(until_s):
                seen += chunk
                at = seen.find(head)
                if at >= 0 and len(seen) >= at + len(head) + length:
                    return seen[at + len(head) :]
        raise NoAnswer(f"no answer to command {request[1]:02X}h{remedy}")

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Collect measurements; a start flag, or an angle that falls back to zero, ends a turn."""
        batches: list[Any] = (
            list(self._capsules.feed(chunk)) if self._is_express else [_points(run) for run in self._nodes.feed(chunk)]
        )
        behind = self._capsules.pending if self._is_express else self._nodes.pending
        behind += sum(len(points[-1]) for points in batches if points is not None)
        for points in batches:
            if points is None:
                self._missed += self._turn is not None
                self._turn = self._begun = None
                continue
            self._heard_s = max(self._heard_s, arrived_s)
            starts, angle_rad, distance_m = points if len(points) == 3 else (self._starts(points[0]), *points)
            for place, part in enumerate(np.split(np.arange(len(angle_rad)), starts)):
                if place:
                    self._finish(arrived_s, behind)
                    self._turn = []
                if self._turn is not None and len(part):
                    self._turn.append((angle_rad[part], distance_m[part]))
                behind -= len(part)
        if arrived_s > self._turn_s + TURN_S:
            raise NoAnswer(
                f"measurements arrive, but no complete turn in {TURN_S:.0f} s; check that its motor turns steadily"
            )

    def _starts(self, angle_rad: Array) -> list[int]:
        starts = split_turns(angle_rad, self._last_rad)
        self._last_rad = float(angle_rad[-1])
        return starts

    def _finish(self, arrived_s: float, behind: int) -> None:
        """Publish the completed turn.

        Args:
            arrived_s: when the chunk arrived.
            behind: measurements since the end of the turn, assumed to take as long as those of the turn.
        """
        begun, self._begun = self._begun, (arrived_s, behind)
        if not self._turn or begun is None or self.beams is None:
            return
        angle_rad, distance_m = (np.concatenate(arrays) for arrays in zip(*self._turn, strict=True))
        if np.ptp(angle_rad) < WHOLE_TURN_RAD or turns_back(angle_rad):
            self._missed += 1
            return
        missed, self._missed = self._missed, 0
        between = len(angle_rad) + behind - begun[1]  # measurements between the two arrivals
        if between > len(angle_rad) / 2:  # with fewer, the jitter of the arrivals would dominate
            self._measurement_s = (arrived_s - begun[0]) / between
        each_s = self._measurement_s or self.beams.scan_s / len(angle_rad)
        self._turn_s = max(self._turn_s, arrived_s)
        self.publish_scan(
            sectors(angle_rad, within(distance_m, self.beams), self.beams.count),
            valid_s=arrived_s - behind * each_s,
            missed=missed,
            quality=self._quality,
        )


def _points(
    run: NDArray[np.uint8] | None,
) -> tuple[list[int], Array, Array] | None:
    """Return the indices of start flags, the angles and the distances of a run of measurements."""
    if run is None:
        return None
    is_start, angle_rad, distance_m = decode(run)
    return [int(place) for place in np.flatnonzero(is_start)], angle_rad, distance_m


def turns_back(angle_rad: Array) -> bool:
    """Return whether an angle goes back by more than the motor's jitter, as noise taken for a measurement does."""
    step_rad = (np.diff(angle_rad) + np.pi) % math.tau - np.pi
    return bool(np.any(step_rad < -JITTER_RAD))


def sectors(angle_rad: Array, range_m: Array, count: int) -> Array:
    """Return the nearest range in each of `count` sectors centred on multiples of the step; NaN in empty ones."""
    seen = np.isfinite(range_m)
    sector = np.round(angle_rad[seen] * (count / math.tau)).astype(np.int64) % count
    nearest = np.full(count, math.inf)
    np.minimum.at(nearest, sector, range_m[seen])
    return np.where(np.isfinite(nearest), nearest, math.nan)


@takes(RplidarOptions)
def connect(context: Context, options: dict[str, Any]) -> Rplidar:
    """Entry point `serial:rplidar`."""
    device = Rplidar(context, read_options(context, options, RplidarOptions))
    device.join(CONNECT_S)
    return device
