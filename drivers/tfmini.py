"""Benewake TFmini-Plus: distance over serial, 100 frames per second (SJ-GU-TFmini-Plus A04, chapters 5 and 7).

The frame `59 59 dist16 strength16 temperature16 sum8` has no counter and no clock, so it is stamped by its arrival.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.transport.checks import sum_low_byte
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes
from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes
from hal.strict import Strict

FRAME_BYTES = 9
RAW_COLDEST, RAW_HOTTEST = (
    (-40 + 256) * 8,
    (100 + 256) * 8,
)  # degrees Celsius of the chip; the sensor works up to 60 outside
RAW_JUMP = 2 * 8  # degrees: a chip that warms up changes by less than 1 degree in a second
AGREEING = 3
STRENGTH_SATURATED = 65_535
GET_VERSION, SET_RATE, SET_UNIT = 0x01, 0x03, 0x05
VERSION_ANSWER = b"\x5a\x07\x01"
UNIT_CODES = {"cm": 1, "mm": 6}
METRES = {"cm": 0.01, "mm": 0.001}
ANSWER_S = 0.15
ATTEMPTS = 3
SILENCE_S = 0.15  # no restart is faster than this, and after a power loss the sensor reports in its factory unit again


def _exchange(link: Link, request: bytes, is_answered: Callable[[bytes], bool]) -> bytes:
    """Return what is received after a request, until it is answered or the time is over."""
    link.write(request, now_s() + ANSWER_S)
    heard, until_s = b"", now_s() + ANSWER_S
    while not is_answered(heard) and (chunk := link.read(until_s)):
        heard += chunk
    return heard


class EchoOptions(Strict):
    """Keys of all sensors of the family: limits of echo strength and range for a valid distance."""

    min_strength: Annotated[int, Field(ge=0, le=65_535, description="a reading with a weaker echo is invalid")] = 100
    min_range_m: Annotated[float, Field(ge=0, description="a smaller distance is invalid")] = 0.0
    max_range_m: Annotated[float, Field(gt=0, le=12, description="a larger distance is invalid")] = 12.0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one reading, one sigma")] = 0.005

    def capabilities(self, rate_hz: float) -> ProximityCapabilities:
        """Return the capabilities given by the options; the data sheet's figures are for large, bright targets."""
        return ProximityCapabilities(
            min_range_m=self.min_range_m, max_range_m=self.max_range_m, sigma_m=self.sigma_m, rate_hz=rate_hz
        )

    def judge(self, distance_m: float, strength: int) -> tuple[float, Quality, Cause]:
        """Return the distance, or NaN and invalid if the echo is too weak, too strong, or out of range."""
        is_seen = (
            self.min_strength <= strength < STRENGTH_SATURATED
            and distance_m > 0.0
            and self.min_range_m <= distance_m <= self.max_range_m
        )
        return (distance_m, Quality.VALID, Cause.NONE) if is_seen else (math.nan, Quality.INVALID, Cause.OUT_OF_RANGE)


class TfminiOptions(SerialOptions, EchoOptions):
    """Options of `serial:tfmini`.

    `unit` is the unit that the sensor is set to. A sensor that accepts no commands keeps its factory unit, cm.
    """

    rate_hz: Annotated[float, Field(ge=1, le=1000, description="measurements per second that the sensor is set to")] = (
        100.0
    )
    unit: Annotated[
        Literal["cm", "mm"],
        Field(description="unit that the sensor is set to; one that accepts no commands keeps its factory unit, cm"),
    ] = "mm"


def command(code: int, payload: bytes = b"") -> bytes:
    """Return the command `5A len id payload sum`, where len counts all bytes."""
    head = bytes([0x5A, 4 + len(payload), code]) + payload
    return head + bytes([sum_low_byte(head)])


class FrameCheck:
    """Checks the sum of a frame, and that its temperature is the one of the frames before.

    A frame that lost bytes reaches into the next one, and its 8-bit sum passes once in 256 times. What then stands in the
    place of the temperature is a header, a sum or an echo strength. The first temperature must be one that a sensor can
    have; one far from the last is believed when three frames in a row agree, so a sensor with another field there works.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the temperature, because the sensor may have been off."""
        self._raw: int | None = None
        self._other: int | None = None
        self._agreeing = 0

    def __call__(self, frame: bytes) -> bool:
        """Return whether the frame is whole."""
        if sum_low_byte(frame[:-1]) != frame[-1]:
            return False
        raw = frame[6] | frame[7] << 8
        if not self._is_believed(raw):
            return False
        self._raw, self._other, self._agreeing = raw, None, 0
        return True

    def _is_believed(self, raw: int) -> bool:
        if self._raw is None and RAW_COLDEST <= raw <= RAW_HOTTEST:
            return True
        if self._raw is not None and abs(raw - self._raw) <= RAW_JUMP:
            return True
        is_alike = self._other is not None and abs(raw - self._other) <= RAW_JUMP
        self._other, self._agreeing = raw, self._agreeing + 1 if is_alike else 1
        return self._agreeing >= AGREEING


def data_framer(check: FrameCheck | None = None) -> Framer:
    """Return a framer for data frames; `59 59` also occurs inside frames, so sum and temperature decide."""
    return Framer(b"\x59\x59", FRAME_BYTES, check or FrameCheck())


class Tfmini(StreamDevice[float]):
    """Distance sensor of a finger."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: TfminiOptions) -> None:
        opener, name = serial_opener(options, context.name)
        period_s = 1.0 / options.rate_hz
        super().__init__(
            context,
            open_link=opener,
            link_name=name,
            max_age_s=max(3.0 * period_s, 0.05),
            silence_s=SILENCE_S,
        )
        self._options = options
        self._check = FrameCheck()
        self._framer = data_framer(self._check)
        self._bad_before = 0
        self._times = FrameTimes(period_s=period_s, frame_bytes=FRAME_BYTES)
        self._unit_m = METRES[options.unit]

    def capabilities(self) -> ProximityCapabilities:
        """Return the capabilities given by the options."""
        return self._options.capabilities(self._options.rate_hz)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance; invalid and NaN when the echo is too weak or out of range."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Set unit and rate; a sensor that confirms neither unit sends cm, its factory unit and the last one tried."""
        self._framer.reset()
        self._check.reset()
        self._times.reset()
        asked = command(GET_VERSION)  # if this very command comes back, the line echoes
        seen = _exchange(link, asked, lambda data: VERSION_ANSWER in data)
        is_echoing = asked in seen
        for unit in dict.fromkeys((self._options.unit, "cm")):
            is_confirmed, heard = self._tell(link, SET_UNIT, bytes([UNIT_CODES[unit]]), is_echoing=is_echoing)
            self._unit_m = METRES[unit]
            seen += heard
            if is_confirmed:
                break
        if not data_framer().feed(seen) and not is_confirmed:
            raise NoAnswer(f"no data frame of a TFmini in {len(seen)} bytes")
        self._tell(link, SET_RATE, struct.pack("<H", round(self._options.rate_hz)), is_echoing=is_echoing)

    def _tell(self, link: Link, code: int, payload: bytes, *, is_echoing: bool) -> tuple[bool, bytes]:
        """Send a command until its answer appears between data frames; return whether it came, and all bytes received.

        The answer repeats the command, as does the echo of a two-wire line; on a line that echoes it must come twice.
        """
        wanted = command(code, payload)
        seen = b""
        for _ in range(ATTEMPTS):
            heard = _exchange(link, wanted, lambda data: data.count(wanted) > is_echoing)
            seen += heard
            if heard.count(wanted) > is_echoing:
                return True, seen
        return False, seen

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame."""
        for frame, valid_s in self._times.stamped(self._framer.feed(chunk), arrived_s=arrived_s, byte_s=self.byte_s):
            self._publish(frame, valid_s)

    def _publish(self, frame: bytes, valid_s: float) -> None:
        raw, strength = struct.unpack_from("<HH", frame, 2)
        value, quality, cause = self._options.judge(raw * self._unit_m, strength)
        bad, self._bad_before = self._framer.counts.bad - self._bad_before, self._framer.counts.bad
        self.publish(value, valid_s=valid_s, quality=quality, cause=cause, missed=bad)


@takes(TfminiOptions)
def connect(context: Context, options: dict[str, Any]) -> Tfmini:
    """Entry point `serial:tfmini`."""
    device = Tfmini(context, read_options(context, options, TfminiOptions))
    device.join()
    return device
