"""SICK LMS 200 family over RS-232/422 (LMS 2xx telegram listing; frames as in MRPT's CSickLaserSerial).

The scanner is found at any of its four baud rates, switched to the configured one, set to millimetres, and started.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.kinds.line_scanners import Beams, Bias, LineScanner
from drivers.transport.capture import inside
from drivers.transport.checks import crc_sick
from drivers.transport.framing import Framer
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.options import SerialOptions, read_options, serial_opener
from drivers.transport.serial_link import SerialLink
from drivers.transport.timebase import FrameTimes
from hal.readings import Quality
from hal.registry import Context, takes

BAUD_CODES = {9600: 0x42, 19_200: 0x41, 38_400: 0x40, 500_000: 0x48}
ACK, NAK, NOT_ACCEPTED = 0x06, 0x15, 0x92
MODE, SCAN, STATUS, VARIANT, READ_CONFIG, WRITE_CONFIG = 0x20, 0xB0, 0x31, 0x3B, 0x74, 0x77
STREAM, ON_REQUEST, SET_UP = 0x24, 0x25, 0x00
PASSWORD = b"SICK_LMS"
UNIT_BYTE, MILLIMETRES = 6, 1
FIRST_CODE = 0x1FF7
LONGEST_PAYLOAD = 812
WARNING, ERROR, FATAL = 2, 3, 4
ANSWER_S, SLOW_S = 0.15, 0.6
SET_UP_S = 3.0
CONNECT_S = 9.0  # four baud rates with three requests each, then one with a longer wait
HEADER_BYTES = 4
KEPT_BYTES = 4096


class Lms200Options(SerialOptions):
    """Options of `serial:lms200`."""

    baud: Annotated[
        Literal[9600, 19200, 38400, 500000],
        Field(description="baud rate that the scanner is set to; it is found at any of the four"),
    ] = 38_400
    field_deg: Annotated[Literal[100, 180], Field(description="angle of the field of view")] = 180
    step_hundredths_deg: Annotated[
        Literal[25, 50, 100], Field(description="angle between two beams, in hundredths of a degree")
    ] = 100
    max_range_m: Annotated[float, Field(gt=0, le=80, description="a larger distance has no value")] = 8.0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one distance, one sigma")] = 0.015
    bias_sigma_m: Bias = 0.0


def telegram(payload: bytes, *, address: int = 0) -> bytes:
    """Return the telegram `02 addr len16 payload crc16`."""
    body = struct.pack("<BBH", 2, address, len(payload)) + payload
    return body + struct.pack("<H", crc_sick(body))


def framer(address: int = 0x80, *, payload_bytes: int | None = None) -> Framer:
    """Return a framer for telegrams from one side; if the length is given, a false header cannot delay a true one."""

    def length(data: bytes) -> int | None:
        size = _length(data)
        return 0 if payload_bytes is not None and size not in (None, HEADER_BYTES + payload_bytes + 2) else size

    return Framer(bytes([2, address]), length, _is_whole)


def _is_whole(frame: bytes) -> bool:
    return crc_sick(frame[:-2]) == frame[-2] | frame[-1] << 8


def payloads_in(seen: bytes) -> Iterator[bytes]:
    """Yield the payloads of all complete telegrams, also after a false header that promises more bytes than will come."""
    at = seen.find(b"\x02\x80")
    while at >= 0:
        frame = seen[at : at + (_length(seen[at:]) or 0)]
        if len(frame) > HEADER_BYTES and len(frame) == _length(frame) and _is_whole(frame):
            yield frame[HEADER_BYTES:-2]
        at = seen.find(b"\x02\x80", at + 1)


def _length(data: bytes) -> int | None:
    if len(data) < HEADER_BYTES:
        return None
    payload = data[2] | data[3] << 8
    return HEADER_BYTES + payload + 2 if 1 <= payload <= LONGEST_PAYLOAD else 0


class Lms200(LineScanner):
    """SICK LMS 200 scanner."""

    def __init__(self, context: Context, options: Lms200Options) -> None:
        opener, name = serial_opener(options, context.name)
        step_deg = options.step_hundredths_deg / 100.0
        beams = Beams(
            count=round(options.field_deg / step_deg) + 1,
            first_rad=-math.radians(options.field_deg) / 2.0,
            step_rad=math.radians(step_deg),
            min_range_m=0.0,
            max_range_m=options.max_range_m,
            scan_s=0.0133 / step_deg,  # 75 turns per second, interleaved for finer steps
        )
        line_s = (2 * beams.count + 10) * 10 / options.baud
        super().__init__(context, open_link=opener, link_name=name, max_age_s=3 * max(beams.scan_s, line_s) + 0.1)
        self.beams, self.line_s = beams, line_s
        self.sigma_m, self.bias_sigma_m = options.sigma_m, options.bias_sigma_m
        self._options = options
        self._framer = framer(payload_bytes=2 * beams.count + 4)
        self._bad_before = 0
        self._times = FrameTimes(period_s=beams.scan_s, frame_bytes=2 * beams.count + 10)

    def start(self, link: Link) -> None:
        """Find the scanner, stop it, change the baud rate, set angles and unit, and start the stream."""
        o = self._options
        if self._find(link) != o.baud:
            self._set_mode(link, bytes([BAUD_CODES[o.baud]]))
            self._set_baud(link, o.baud)
        variant = struct.pack("<BHH", VARIANT, o.field_deg, o.step_hundredths_deg)
        answer = self._ask(link, variant, VARIANT | 0x80, SLOW_S)
        if answer[1:2] != b"\x01":
            what = f"the scanner refuses a field of {o.field_deg} deg in steps of {o.step_hundredths_deg / 100} deg"
            raise Refused(what, code=int.from_bytes(answer[1:2]))
        self._set_mode(link, bytes([SET_UP]) + PASSWORD, SET_UP_S)
        config = bytearray(self._ask(link, bytes([READ_CONFIG]), READ_CONFIG | 0x80, SLOW_S)[1:-1])
        if len(config) <= UNIT_BYTE:
            raise NoAnswer(f"its configuration has {len(config)} bytes; is it an LMS 200?")
        if config[UNIT_BYTE] != MILLIMETRES:
            config[UNIT_BYTE] = MILLIMETRES
            self._ask(link, bytes([WRITE_CONFIG]) + bytes(config), WRITE_CONFIG | 0x80, SET_UP_S)
        self._set_mode(link, bytes([STREAM]))
        self._framer.reset()
        self._times.reset()

    def _set_mode(self, link: Link, mode: bytes, wait_s: float = SLOW_S) -> None:
        answer = self._ask(link, bytes([MODE]) + mode, MODE | 0x80, wait_s)
        if len(answer) > 1 and answer[1] != 0:
            raise Refused(f"the scanner refuses operating mode {mode[0]:02X}h", code=answer[1])

    def _find(self, link: Link) -> int:
        """Return the baud rate at which the scanner agrees to stop streaming; the configured rate is tried first."""
        rates = sorted(BAUD_CODES, key=lambda rate: rate != self._options.baud)
        for answer_s, attempts in ((ANSWER_S, 3), (SLOW_S, 1)):
            for rate in rates:
                self._set_baud(link, rate)
                try:
                    self._ask(link, bytes([MODE, ON_REQUEST]), MODE | 0x80, answer_s=answer_s, attempts=attempts)
                except NoAnswer:
                    continue
                drain_until_quiet(link, quiet_s=0.03, until_s=now_s() + ANSWER_S)
                return rate
        raise NoAnswer(f"no answer at {', '.join(map(str, sorted(rates)))} baud")

    @staticmethod
    def _set_baud(link: Link, baud: int) -> None:
        if (line := inside(link, SerialLink)) is not None:
            line.set_baud(baud)

    @staticmethod
    def _ask(
        link: Link, payload: bytes, code: int, wait_s: float = 0.0, *, answer_s: float = ANSWER_S, attempts: int = 3
    ) -> bytes:
        """Return the payload of the answer with `code`.

        Args:
            wait_s: how long to wait for the answer to an acknowledged request. Without acknowledgement the request is
                repeated sooner; afterwards the answers to all repetitions are discarded.
        """
        asked_s = now_s()
        for attempt in range(attempts):
            link.write(telegram(payload), now_s() + ANSWER_S)
            seen, sent_s = b"", now_s()
            while chunk := link.read(sent_s + (max(wait_s, answer_s) if ACK in seen else answer_s)):
                seen = (seen + chunk)[-KEPT_BYTES:]
                answer = next((a for a in payloads_in(seen) if a[0] in (code, NOT_ACCEPTED)), None)
                if answer is None:
                    continue
                if attempt:
                    over_s = now_s() + 0.05 + 1.2 * attempt * (now_s() - asked_s)
                    drain_until_quiet(link, quiet_s=over_s, until_s=over_s)
                if answer[0] == NOT_ACCEPTED:
                    raise Refused(f"the scanner does not accept command {payload[0]:02X}h", code=NOT_ACCEPTED)
                return answer
        raise NoAnswer(f"no answer to command {payload[0]:02X}h")

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete scan."""
        scans = [frame for frame in self._framer.feed(chunk) if frame[HEADER_BYTES] == SCAN]
        for frame, valid_s in self._times.stamped(scans, arrived_s=arrived_s, byte_s=self.byte_s):
            self._take(frame, valid_s)

    def _take(self, frame: bytes, valid_s: float) -> None:
        status = frame[-3]
        if status & 7 >= FATAL:
            raise Refused("the scanner reports a fatal error", code=status)
        range_m = decode_scan(frame[HEADER_BYTES:-2])
        if self.beams is None or len(range_m) != self.beams.count:
            self._framer.counts.bad += 1
            return
        bad, self._bad_before = self._framer.counts.bad - self._bad_before, self._framer.counts.bad
        valid = np.where(range_m <= self.beams.max_range_m, range_m, math.nan)
        quality = {ERROR: Quality.INVALID, WARNING: Quality.DEGRADED}.get(status & 7, Quality.VALID)
        self.publish_scan(valid, valid_s=valid_s, missed=bad, quality=quality)


def decode_scan(payload: bytes) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return metres from a B0 answer, empty when it is truncated; codes from 1FF7h on and zero become NaN."""
    if len(payload) < 3:
        return np.empty(0)
    word = payload[1] | payload[2] << 8
    count, unit_m = word & 0x3FF, 0.001 if word >> 14 == MILLIMETRES else 0.01
    if len(payload) < 3 + 2 * count:
        return np.empty(0)
    raw = np.frombuffer(payload, "<u2", count, 3) & 0x1FFF
    return np.where((raw > 0) & (raw < FIRST_CODE), raw * unit_m, math.nan)


@takes(Lms200Options)
def connect(context: Context, options: dict[str, Any]) -> Lms200:
    """Entry point `serial:lms200`."""
    device = Lms200(context, read_options(context, options, Lms200Options))
    device.join(CONNECT_S)
    return device
