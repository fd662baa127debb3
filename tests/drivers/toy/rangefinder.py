"""Driver of the toy rangefinder RF7 by the manual in `tests.drivers.toy`, adapted from what the scaffold writes."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import Field

from drivers.transport.checks import xor_byte
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, drain, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes
from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

LINE = re.compile(rb"\$D,(\d{3}),(\d{5}),(\d{3})\*")
LINE_BYTES = 20
RATE_HZ = 50.0
ANSWER_S = 0.3


class RangefinderOptions(SerialOptions):
    """Options of `serial:toy`."""

    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 57_600
    min_strength: Annotated[int, Field(ge=0, le=255, description="a reading with a weaker echo is invalid")] = 20


def framer() -> Framer:
    """`$D,counter,distance,strength*XX` and a line feed; XX is the xor of all between `$` and `*`, in hexadecimal."""
    return Framer(b"$D,", LINE_BYTES, lambda line: b"%02X\n" % xor_byte(line[1:-4]) == line[-3:])


class Rangefinder(StreamDevice[float]):
    """Driver of the toy rangefinder."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: RangefinderOptions) -> None:
        opener, link_name = serial_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=link_name, max_age_s=3.0 / RATE_HZ)
        self._least = options.min_strength
        self._framer = framer()
        self._times = FrameTimes(period_s=1.0 / RATE_HZ, frame_bytes=LINE_BYTES)
        self._counter: int | None = None

    def capabilities(self) -> ProximityCapabilities:
        """Return the figures of the data sheet."""
        return ProximityCapabilities(min_range_m=0.02, max_range_m=8.0, sigma_m=0.0005, rate_hz=RATE_HZ)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest distance."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Stop the stream, identify the sensor, and start the stream."""
        until_s, heard = now_s() + ANSWER_S, b""
        link.write(b"STOP\nID?\n", until_s)
        while b"RF7 " not in heard:
            if now_s() >= until_s:
                raise NoAnswer("no RF7 answers to ID?")
            heard += link.read(until_s)
        drain(link)
        self._framer.reset()
        self._times.reset()
        self._counter = None
        link.write(b"GO\n", until_s + ANSWER_S)

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each line; its counter shows which lines were lost or repeated."""
        lines = self._framer.feed(chunk)
        for line, valid_s in self._times.stamped(lines, arrived_s=arrived_s, byte_s=self.byte_s):
            if (fields := LINE.match(line)) is None:
                continue
            counter, tenths_mm, strength = map(int, fields.groups())
            gap = 1 if self._counter is None else (counter - self._counter) % 256
            if gap == 0:
                continue
            self._counter = counter
            is_weak = strength < self._least
            quality, cause = (Quality.INVALID, Cause.OUT_OF_RANGE) if is_weak else (Quality.VALID, Cause.NONE)
            self.publish(tenths_mm / 10_000.0, valid_s=valid_s, quality=quality, cause=cause, missed=gap - 1)


@takes(RangefinderOptions)
def connect(context: Context, options: dict[str, Any]) -> Rangefinder:
    """Entry point `serial:toy`."""
    device = Rangefinder(context, read_options(context, options, RangefinderOptions))
    device.join()
    return device
