"""Slamtec RPLIDAR A1/A2 over serial, standard and express scans (Slamtec interface protocol, LR001).

A measurement of a standard scan has five bytes and no checksum, only a start bit next to its inverse and one bit that
is always 1. A measurement is therefore accepted only when the next eight are in step too; a misstep leaves a gap in the
turn. A turn with a gap is given as it is, with quality `degraded` and the missing angle, unless half of it is missing.
"""

from __future__ import annotations

import math
import struct
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.line_scanners import Beams, Bias, LineScanner, within
from drivers.rplidar.express import CAPSULE_BYTES, EXPRESS_TYPE, REQUEST, CapsuleParser, Points
from drivers.rplidar.nodes import NodeParser, decode
from drivers.rplidar.times import MeasurementTimes
from drivers.rplidar.turns import LARGEST_AGE, MOST_MISSING_RAD, Measurements, TurnCollector, missing_rad
from drivers.transport.capture import inside
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.serial_link import SerialLink
from drivers.transport.timebase import Pauses
from hal.arrays import Array
from hal.readings import Quality
from hal.registry import Context, takes

STOP, RESET, START_SCAN, GET_INFO, GET_HEALTH = 0x25, 0x40, 0x20, 0x50, 0x52
INFO_TYPE, HEALTH_TYPE, SCAN_TYPE = 0x04, 0x06, 0x81
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
    bias_sigma_m: Bias = 0.0


def descriptor(length: int, mode: int, kind: int) -> bytes:
    """Return the descriptor: `A5 5A`, 30 bits of length and 2 of mode, type."""
    return struct.pack("<BBIB", 0xA5, 0x5A, length | mode << 30, kind)


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
        self.sigma_m, self.bias_sigma_m = options.sigma_m, options.bias_sigma_m
        self._is_express = options.mode == "express"
        self._nodes, self._capsules, self._turns = NodeParser(), CapsuleParser(), TurnCollector()
        self._pauses = Pauses()
        self._arrived_s = math.inf
        self._turn_s = now_s()
        self._times, self._ended_s = MeasurementTimes(), math.inf  # end of the turn before
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
        self._nodes, self._capsules, self._turns = NodeParser(), CapsuleParser(), TurnCollector()
        self._pauses.reset()
        self._arrived_s = self._ended_s = math.inf
        self._times.reset()
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
        """Collect measurements and publish each complete turn; what may have been held up is left out."""
        if self._pauses.may_be_held_up(arrived_s, len(chunk)):
            self._nodes, self._capsules, self._ended_s = NodeParser(), CapsuleParser(), math.inf
            self._times.reset()
        else:
            self._collect(chunk, arrived_s)
        self._arrived_s = arrived_s
        if arrived_s > self._turn_s + TURN_S:
            raise NoAnswer(
                f"measurements arrive, but no complete turn in {TURN_S:.0f} s; check that its motor turns steadily"
            )

    def _collect(self, chunk: bytes, arrived_s: float) -> None:
        parser = self._capsules if self._is_express else self._nodes
        waited = parser.pending  # so many of the next measurements came with an earlier chunk
        batches = [_points(run) for run in parser.feed(chunk)]
        turns = []
        for points in batches:
            if points is None:
                self.errors += 1
                self._times.reset()  # measurements are lost, so their number is no clock
                continue
            self._heard_s = max(self._heard_s, arrived_s)
            arrivals_s = np.where(np.arange(len(points[0])) < waited, min(self._arrived_s, arrived_s), arrived_s)
            waited = max(0, waited - len(points[0]))
            head_rad, angle_rad, distance_m = points
            new = Measurements(head_rad=head_rad, angle_rad=angle_rad, distance_m=distance_m, arrived_s=arrivals_s)
            turns += list(self._turns.add(new))
        self._times.add(arrived_s, self._turns.count + self._turns.pending + parser.pending)
        for turn, ended in turns:
            self._finish(turn, arrived_s, ended)

    def _finish(self, turn: Measurements, arrived_s: float, ended: int) -> None:
        """Publish a complete turn, without the measurements that a long gap left behind.

        Args:
            arrived_s: when the chunk arrived that confirmed the turn.
            ended: measurements received up to the end of the turn.
        """
        if self.beams is None:
            return
        whole = len(turn) / max(1.0 - missing_rad(turn.head_rad) / math.tau, 0.5)
        ended_s = min(self._times.taken_s(ended, self.beams.scan_s / whole), float(turn.arrived_s[-1]))
        lasted_s, self._ended_s = ended_s - self._ended_s, ended_s
        turn = turn.at(turn.arrived_s > ended_s - LARGEST_AGE * max(lasted_s, self.beams.scan_s))
        lacking_rad = missing_rad(turn.head_rad)
        if lacking_rad > MOST_MISSING_RAD:
            self._missed += 1
            return
        missed, self._missed = self._missed + self._turns.discarded, 0
        self._turns.discarded = 0
        self._turn_s = max(self._turn_s, arrived_s)
        self.publish_scan(
            sectors(turn.angle_rad, within(turn.distance_m, self.beams), self.beams.count),
            valid_s=ended_s,
            missed=missed,
            quality=self._quality,
            lacking_rad=lacking_rad,
        )


def _points(run: NDArray[np.uint8] | Points | None) -> Points | None:
    """Return the measurements of a run of nodes, whose angles are already corrected, or of a capsule."""
    if not isinstance(run, np.ndarray):
        return run
    angle_rad, distance_m = decode(run)
    return angle_rad, angle_rad, distance_m


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
