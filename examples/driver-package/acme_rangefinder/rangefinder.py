"""Driver of rangefinder: say what it measures, over which wire, and which manual describes its protocol."""

from __future__ import annotations

import struct
from typing import Any

from drivers.transport.checks import sum_low_byte
from drivers.transport.framing import Framer
from drivers.transport.link import Link, drain
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes
from hal.clock import Deadline
from hal.devices import DeviceKind, ProximityCapabilities
from hal.readings import Stamped
from hal.registry import Context, takes

HEADER = b"\xa5\x5a"
FRAME = struct.Struct("<2sB1iB")
RATE_HZ = 50.0


class RangefinderOptions(SerialOptions):
    """Options of `serial:rangefinder`; add keys as the device needs them."""


def framer() -> Framer:
    """`A5 5A counter values sum`."""
    return Framer(HEADER, FRAME.size, lambda frame: sum_low_byte(frame[:-1]) == frame[-1])


class Rangefinder(StreamDevice[float]):
    """Driver of rangefinder."""

    kind = DeviceKind.PROXIMITY

    def __init__(self, context: Context, options: RangefinderOptions) -> None:
        opener, link_name = serial_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=link_name, max_age_s=3.0 / RATE_HZ)
        self._framer = framer()
        self._times = FrameTimes(period_s=1.0 / RATE_HZ, frame_bytes=FRAME.size)
        self._counter: int | None = None

    def capabilities(self) -> ProximityCapabilities:
        """Return the figures of the manufacturer's data sheet."""
        return ProximityCapabilities(min_range_m=0.0, max_range_m=4.0, sigma_m=0.001, rate_hz=RATE_HZ)

    def read_distance_m(self, *, deadline: Deadline) -> Stamped[float]:
        """Return the newest sample."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Bring the device from any state to streaming: stop, identify, configure, start. This one needs none of it."""
        drain(link)
        self._framer.reset()
        self._times.reset()
        self._counter = None

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame; its counter shows which frames were lost or repeated."""
        for frame, valid_s in self._times.stamped(self._framer.feed(chunk), arrived_s=arrived_s, byte_s=self.byte_s):
            _, counter, *numbers, _ = FRAME.unpack(frame)
            gap = 1 if self._counter is None else (counter - self._counter) % 256
            if gap == 0:
                continue
            self._counter = counter
            value = numbers[0] / 1000.0
            self.publish(value, valid_s=valid_s, missed=gap - 1)


@takes(RangefinderOptions)
def connect(context: Context, options: dict[str, Any]) -> Rangefinder:
    """Entry point `serial:rangefinder`."""
    device = Rangefinder(context, read_options(context, options, RangefinderOptions))
    device.join()
    return device
