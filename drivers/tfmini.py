"""Benewake TFmini-Plus: distance over serial, 100 frames a second (SJ-GU-TFmini-Plus A04, chapters 5 and 7).

The frame `59 59 dist16 strength16 temperature16 sum8` has no counter and no clock, so the arrival time stamps it.
"""

from __future__ import annotations

import math
import struct
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.transport.checks import sum_low_byte
from drivers.transport.device import StreamDevice
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context

FRAME_BYTES = 9
STRENGTH_SATURATED = 65_535
SET_RATE, SET_UNIT = 0x03, 0x05
UNIT_CODES = {"cm": 1, "mm": 6}
METRES = {"cm": 0.01, "mm": 0.001}
ANSWER_S = 0.15
ATTEMPTS = 3


class TfminiOptions(SerialOptions):
    """Options of `serial:tfmini`.

    `unit` is what the sensor is told to send; a sensor that takes no commands must be left at its factory unit, cm.
    """

    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    unit: Literal["cm", "mm"] = "mm"
    min_strength: Annotated[int, Field(ge=0, le=65_535)] = 100
    min_range_m: Annotated[float, Field(ge=0)] = 0.0
    max_range_m: Annotated[float, Field(gt=0, le=12)] = 12.0
    sigma_m: Annotated[float, Field(gt=0)] = 0.005


def command(code: int, payload: bytes = b"") -> bytes:
    """`5A len id payload sum`, len counting all bytes."""
    head = bytes([0x5A, 4 + len(payload), code]) + payload
    return head + bytes([sum_low_byte(head)])


def data_framer() -> Framer:
    """Data frames; `59 59` also occurs inside frames, so the sum decides."""
    return Framer(b"\x59\x59", FRAME_BYTES, lambda f: sum_low_byte(f[:-1]) == f[-1])


class Tfmini(StreamDevice[float]):
    """A finger's distance sensor."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: TfminiOptions) -> None:
        opener, name = serial_opener(options, context.name)
        period_s = 1.0 / options.rate_hz
        super().__init__(context, open_link=opener, link_name=name, max_age_s=max(3.0 * period_s, 0.05))
        self._options = options
        self._framer = data_framer()
        self._bad_before = 0
        self._last = (b"", 0.0)

    def capabilities(self) -> ProximityCapabilities:
        """From the options: the maker's figures are for big, bright targets."""
        o = self._options
        return ProximityCapabilities(
            min_range_m=o.min_range_m, max_range_m=o.max_range_m, sigma_m=o.sigma_m, rate_hz=o.rate_hz
        )

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Newest distance; invalid and NaN when the echo is too weak or outside the range."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Set unit and rate; without an answer only the factory unit may be trusted."""
        self._framer.reset()
        confirmed = self._tell(link, SET_UNIT, bytes([UNIT_CODES[self._options.unit]]))
        if not confirmed and self._options.unit != "cm":
            raise NoAnswer("the sensor does not confirm its unit; for one that takes no commands set unit = 'cm'")
        self._tell(link, SET_RATE, struct.pack("<H", round(self._options.rate_hz)))

    def _tell(self, link: Link, code: int, payload: bytes) -> bool:
        """Send a command until its answer stands between the data frames."""
        wanted = command(code, payload)
        for _ in range(ATTEMPTS):
            link.write(wanted, now_s() + ANSWER_S)
            seen, until_s = b"", now_s() + ANSWER_S
            while chunk := link.read(until_s):
                seen += chunk
                if wanted in seen:  # the sensor repeats the command; two of them where the line echoes
                    return True
        return False

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame; the last ended just now, those before it one period earlier each."""
        frames = self._framer.feed(chunk)
        for back, frame in zip(range(len(frames) - 1, -1, -1), frames, strict=True):
            self._publish(frame, arrived_s - FRAME_BYTES * self.byte_s - back / self._options.rate_hz)

    def _publish(self, frame: bytes, valid_s: float) -> None:
        if frame == self._last[0] and valid_s - self._last[1] < 0.3 / self._options.rate_hz:
            return  # the same bytes at the same moment are a repeated frame
        self._last = (frame, valid_s)
        raw, strength = struct.unpack_from("<HH", frame, 2)
        distance_m = raw * METRES[self._options.unit]
        is_seen = (
            self._options.min_strength <= strength < STRENGTH_SATURATED
            and raw > 0
            and self._options.min_range_m <= distance_m <= self._options.max_range_m
        )
        bad, self._bad_before = self._framer.counts.bad - self._bad_before, self._framer.counts.bad
        self.publish(
            distance_m if is_seen else math.nan,
            valid_s=valid_s,
            quality=Quality.VALID if is_seen else Quality.INVALID,
            cause=Cause.NONE if is_seen else Cause.OUT_OF_RANGE,
            missed=bad,
        )


def connect(context: Context, options: dict[str, Any]) -> Tfmini:
    """Entry point `serial:tfmini`."""
    device = Tfmini(context, read_options(context, options, TfminiOptions))
    device.join()
    return device
