"""Bota SensONE over serial: binary frames with CRC and a microsecond clock (after Bota's BotaForceTorqueSensorComm)."""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.kinds.force_torque import RangeOptions, capabilities
from drivers.transport.checks import crc_x25
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import HostTime, Unwrapper
from hal.clock import Deadline
from hal.devices import DeviceKind, ForceTorqueCapabilities, Wrench
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

FRAME_BYTES = 37
BODY = struct.Struct("<H6fIf")
SLOW, OVERRANGE, INVALID, RAW = 1, 2, 4, 8
SINC_S = 19.53125e-6  # sampling period per unit of filter length
POWER_UP_TEXT = b"App Init"
BAUD_CODES = {9600: 0, 57_600: 1, 115_200: 2, 230_400: 3, 460_800: 4}
ANSWER_S = 0.25
ATTEMPTS = 6


class BotaOptions(SerialOptions, RangeOptions):
    """Options of `serial:bota`; `sinc_length` sets the rate: 512 gives 100 Hz, 64 gives 800 Hz."""

    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 460_800
    sinc_length: Annotated[
        int,
        Field(
            ge=51,
            le=512,
            description="length of the sensor's filter, which sets the rate: 512 gives 100 Hz, 64 gives 800 Hz",
        ),
    ] = 512
    max_age_s: Annotated[float, Field(gt=0, le=1, description="an older sample is not returned")] = 0.05


def framer() -> Framer:
    """Return a framer for AA, 34 bytes, and a CRC over them."""
    return Framer(b"\xaa", FRAME_BYTES, lambda f: crc_x25(f[1:-2]) == f[-2] | f[-1] << 8)


class Bota(StreamDevice[Wrench]):
    """Bota SensONE force/torque sensor on a serial line."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self, context: Context, options: BotaOptions) -> None:
        opener, name = serial_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=options.max_age_s, silence_s=0.3)
        self._options = options
        self._framer = framer()
        self._clock = Unwrapper(bits=32, tick_s=1e-6)
        self._host = HostTime()
        self._last_us: int | None = None
        self._bad_before = 0
        self._tail = b""  # end of the last chunk: the power-up text may be split over two chunks
        self._wants_lines = False

    @property
    def period_s(self) -> float:
        """Return the time between samples, in seconds."""
        return self._options.sinc_length * SINC_S

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(self._options, 1.0 / self.period_s)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Enter set-up mode, select calibrated values in binary frames, set the filter, and run."""
        self._command(link, "C")
        if (baud_code := BAUD_CODES.get(self._options.baud)) is not None:
            with suppress(NoAnswer, Refused):  # the sensor then keeps its old settings, which its frames reveal
                self._command(link, f"c,0,1,0,{baud_code}", attempts=2)
        self._command(link, f"f,{self._options.sinc_length},0,0,0")
        drain_until_quiet(link, quiet_s=0.01, until_s=now_s() + ANSWER_S)
        self._command(link, "R")
        self._framer.reset()
        self._tail = b""
        self._clock, self._last_us = Unwrapper(bits=32, tick_s=1e-6), None
        self._host.reset()

    def _command(self, link: Link, text: str, *, attempts: int = ATTEMPTS) -> None:
        """Send a command until `r,0,X,0` appears among the data, where X is the command's letter.

        The manufacturer's client sends no line end, but other parsers read lines. The variant that worked last is tried
        first.
        """
        refusal = b""
        for attempt in range(attempts):
            is_line = self._wants_lines != bool(attempt % 2)
            link.write((f"\r\n{text}\r\n" if is_line else text).encode(), now_s() + ANSWER_S)
            seen, until_s = b"", now_s() + ANSWER_S
            while chunk := link.read(until_s):
                seen = (seen + chunk)[-4096:]
                if answer := re.search(rb"r,(\d+),%c,\d" % text[0].encode(), seen):
                    break
            else:
                continue
            if answer[1] == b"0":
                self._wants_lines = is_line
                return
            refusal = answer[0]
        if refusal:
            raise Refused(f"the sensor refuses {text!r}: {refusal.decode()}", code=int(refusal.split(b",")[1]))
        raise NoAnswer(f"the sensor does not confirm {text!r}; wrong baud rate or another device?")

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame; the power-up text means that the sensor has lost its settings."""
        if POWER_UP_TEXT in self._tail + chunk:
            raise NoAnswer("the sensor has restarted, so it has lost its settings")
        self._tail = (self._tail + chunk)[1 - len(POWER_UP_TEXT) :]
        for frame in self._framer.feed(chunk):
            self._take(frame, arrived_s - FRAME_BYTES * self.byte_s)

    def _take(self, frame: bytes, arrived_s: float) -> None:
        status, fx, fy, fz, tx, ty, tz, stamp_us, _ = BODY.unpack(frame[1:-2])
        if stamp_us == self._last_us:
            return  # repeated frame
        self._last_us = stamp_us
        device_s = self._clock.seconds(stamp_us)
        value = Wrench(force_n=np.array([fx, fy, fz], dtype=float), torque_nm=np.array([tx, ty, tz], dtype=float))
        quality, cause = _condition(status, value)
        bad, self._bad_before = self._framer.counts.bad - self._bad_before, self._framer.counts.bad
        self.publish(
            value,
            valid_s=self._host.host_s(device_s=device_s, arrived_s=arrived_s),
            device_time_s=device_s,
            quality=quality,
            cause=cause,
            missed=bad,
        )


def _condition(status: int, value: Wrench) -> tuple[Quality, Cause]:
    if status & OVERRANGE:
        return Quality.INVALID, Cause.SATURATED
    if status & (INVALID | RAW) or not np.all(np.isfinite([*value.force_n, *value.torque_nm])):
        return Quality.INVALID, Cause.DEVICE
    return (Quality.DEGRADED, Cause.DEVICE) if status & SLOW else (Quality.VALID, Cause.NONE)


@takes(BotaOptions)
def connect(context: Context, options: dict[str, Any]) -> Bota:
    """Entry point `serial:bota`."""
    device = Bota(context, read_options(context, options, BotaOptions))
    device.join()
    return device
