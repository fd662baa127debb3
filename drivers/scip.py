"""Hokuyo URG, UTM and UST scanners: SCIP 2.0 over USB serial or TCP (C-42-03320B, pp 3-11).

Geometry and limits come from the scanner's own parameters (PP); scans stream endlessly (MD) with a 24-bit
millisecond clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.kinds.line_scanners import Beams, Bias, LineScanner, within
from drivers.transport.checks import sum_scip
from drivers.transport.link import Link, NoAnswer, Refused, drain_until_quiet, now_s
from drivers.transport.options import EitherOptions, PortNumber, SerialPath, either_opener, read_options
from drivers.transport.timebase import HostTime, Unwrapper
from hal.registry import Context, takes

FIRST_DISTANCE_MM = 20  # smaller values are error codes
STAMP_BITS, STAMP_S = 24, 0.001
ANSWER_S = 0.5
MESSAGE_LIMIT = 20_000  # longer than any scanner's message
OK, LASER_ALREADY_ON, DATA, RESUMED = "00", "02", "99", "98"


class ScipOptions(EitherOptions):
    """Options of `scip:scanner`: a serial path, or `host` with `port` (10940)."""

    port: SerialPath | PortNumber = 10940
    cluster: Annotated[
        int, Field(ge=1, le=99, description="neighbouring steps that the scanner merges into one beam")
    ] = 1
    skip_scans: Annotated[
        int, Field(ge=0, le=9, description="scans that the scanner leaves out after each one it sends")
    ] = 0
    sigma_m: Annotated[float, Field(gt=0, description="noise of one distance, one sigma")] = 0.01
    bias_sigma_m: Bias = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One answer: its echo, its status and the lines that follow, with checksums verified and removed."""

    echo: str
    status: str
    lines: tuple[bytes, ...]


def decode_number(text: bytes) -> int:
    """Decode a number with six bits per character, high first, each plus 30h."""
    value = 0
    for character in text:
        value = value << 6 | (character - 0x30)
    return value


def decode_ranges_mm(data: bytes) -> NDArray[np.int32]:
    """Decode distances of three characters each; join the lines first, because values may straddle them."""
    packed = np.zeros((len(data) // 3, 4), np.uint8)
    packed[:, 1:] = np.frombuffer(data, np.uint8).reshape(-1, 3)
    bits = packed.view(">u4")[:, 0].astype(np.int32) - 0x303030  # 00hhhhhh 00mmmmmm 00llllll
    return (bits >> 4 & 0x3F000) | (bits >> 2 & 0xFC0) | (bits & 0x3F)


def is_encoded(data: bytes) -> bool:
    """Return whether all characters are within 30h to 6Fh; the six-bit sum does not cover the upper two bits."""
    c = np.frombuffer(data, np.uint8)
    return bool(np.all(c - np.uint8(0x30) < 0x40))


def checked(line: bytes) -> bytes | None:
    """Return the line without its checksum, or None if that is wrong.

    Makers sum `KEY:value;` lines with or without `;`.
    """
    if not line:
        return None
    body, sum_ = line[:-1], line[-1]
    is_right = sum_scip(body) == sum_ or (body[-1:] == b";" and sum_scip(body[:-1]) == sum_)
    return body if is_right else None


class ScipParser:
    """Parses answers from bytes in chunks of any size; an answer ends with an empty line."""

    def __init__(self) -> None:
        self._buffer = b""
        self.bad = 0

    def reset(self) -> None:
        """Discard the kept bytes."""
        self._buffer = b""

    def feed(self, chunk: bytes, echo: str) -> list[Message]:
        """Return complete answers whose echo begins with `echo`; damaged ones are counted."""
        self._buffer += chunk
        if b"\n\n" not in self._buffer[-len(chunk) - 1 :]:  # only the new part can have completed an answer
            self._buffer = self._buffer[-MESSAGE_LIMIT:]
            return []
        *blocks, self._buffer = self._buffer.split(b"\n\n")
        found = [self._message(block, echo.encode()) for block in blocks]
        return [message for message in found if message is not None]

    def _message(self, block: bytes, echo: bytes) -> Message | None:
        lines = block.split(b"\n")
        starts = [i for i, line in enumerate(lines) if echo in line]  # noise may precede it; the last echo counts
        if not starts or len(lines) < starts[-1] + 2:
            self.bad += bool(starts)
            return None
        first = starts[-1]
        status, *rest = (checked(line) for line in lines[first + 1 :])
        if status is None or None in rest or len(status) != 2:
            self.bad += 1
            return None
        head = lines[first]
        return Message(
            echo=head[head.rindex(echo) :].decode("ascii", "replace"),
            status=status.decode("ascii", "replace"),
            lines=tuple(line for line in rest if line is not None),
        )


def parse_parameters(block: tuple[bytes, ...]) -> dict[str, str]:
    """Return the `KEY:value;` lines of VV, PP and II answers as a dictionary."""
    pairs = (line.decode("ascii", "replace").rstrip(";").split(":", 1) for line in block if b":" in line)
    return {key: value for key, value in pairs}


class Scip(LineScanner):
    """Hokuyo scanner."""

    def __init__(self, context: Context, options: ScipOptions) -> None:
        opener, name = either_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=0.05)
        self.sigma_m, self.bias_sigma_m = options.sigma_m, options.bias_sigma_m
        self._options = options
        self._parser = ScipParser()
        self._request = ""
        self._clock = Unwrapper(bits=STAMP_BITS, tick_s=STAMP_S)
        self._host = HostTime()
        self._last_stamp: int | None = None
        self._bad_before = 0

    def start(self, link: Link) -> None:
        """Stop any running stream, read the geometry, switch the laser on, and start the stream."""
        self._parser.reset()
        link.write(b"\nQT\n", now_s() + ANSWER_S)
        drain_until_quiet(link, quiet_s=0.05, until_s=now_s() + ANSWER_S)
        parameters = parse_parameters(self._ask(link, "PP", OK).lines)
        self.beams = self._geometry(parameters)
        self.max_age_s = max(self.max_age_s, 3.0 * self.beams.scan_s)
        self._ask(link, "BM", OK, LASER_ALREADY_ON)
        first, last = int(parameters["AMIN"]), int(parameters["AMAX"])
        self._request = f"MD{first:04d}{last:04d}{self._options.cluster:02d}{self._options.skip_scans}"
        self._ask(link, self._request + "00", OK, DATA)
        self._clock, self._last_stamp = Unwrapper(bits=STAMP_BITS, tick_s=STAMP_S), None
        self._host.reset()

    def _geometry(self, parameters: dict[str, str]) -> Beams:
        try:
            number = {key: int(parameters[key]) for key in ("AMIN", "AMAX", "AFRT", "ARES", "DMIN", "DMAX", "SCAN")}
        except (KeyError, ValueError) as error:
            raise NoAnswer(f"the scanner's parameters lack {error}; is it a SCIP 2.0 scanner?") from None
        if number["ARES"] < 1 or number["SCAN"] < 1:
            said = f"ARES {number['ARES']} steps per turn, SCAN {number['SCAN']} turns per minute"
            raise NoAnswer(f"the scanner reports {said}, but both must be at least 1; is it a SCIP 2.0 scanner?")
        step_rad = math.tau / number["ARES"] * self._options.cluster
        return Beams(
            count=(number["AMAX"] - number["AMIN"]) // self._options.cluster + 1,
            first_rad=(number["AMIN"] - number["AFRT"]) * math.tau / number["ARES"],
            step_rad=step_rad,
            min_range_m=number["DMIN"] / 1000.0,
            max_range_m=number["DMAX"] / 1000.0,
            scan_s=60.0 / number["SCAN"] * (1 + self._options.skip_scans),
        )

    def _ask(self, link: Link, command: str, *good: str) -> Message:
        """Send a command and return its answer; up to three attempts."""
        for _ in range(3):
            link.write(command.encode() + b"\n", now_s() + ANSWER_S)
            until_s = now_s() + ANSWER_S
            while chunk := link.read(until_s):
                for message in self._parser.feed(chunk, command):
                    if message.status in good:
                        return message
                    raise _refusal(command, message.status)
        raise NoAnswer(f"no answer to {command}")

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each whole, undamaged scan."""
        for message in self._parser.feed(chunk, self._request):
            if message.status == DATA:
                self._take(message, arrived_s)
            elif message.status not in (OK, RESUMED):
                raise _refusal(self._request, message.status)

    def _take(self, message: Message, arrived_s: float) -> None:
        beams, data = self.beams, b"".join(message.lines[1:])
        stamp_text = message.lines[0] if message.lines else b""
        is_whole = beams is not None and len(stamp_text) == 4 and len(data) == 3 * beams.count
        if beams is None or not is_whole or not is_encoded(stamp_text + data):
            self._parser.bad += 1
            return
        stamp = decode_number(stamp_text)
        if stamp == self._last_stamp:
            return  # repeated scan
        self._last_stamp = stamp
        range_mm = decode_ranges_mm(data)
        range_m = np.where(range_mm < FIRST_DISTANCE_MM, math.nan, range_mm / 1000.0)
        device_s = self._clock.seconds(stamp)
        bad, self._bad_before = self._parser.bad - self._bad_before, self._parser.bad
        self.publish_scan(
            within(range_m, beams),
            valid_s=self._host.host_s(device_s=device_s, arrived_s=arrived_s),
            device_time_s=device_s,
            missed=bad,
        )


def _refusal(command: str, status: str) -> Refused:
    kind = "hardware trouble" if "50" <= status <= "97" else "check or argument error"
    code = int(status, 16) if all(c in "0123456789ABCDEFabcdef" for c in status) else -1
    return Refused(f"status {status} to {command[:2]} ({kind})", code=code)


@takes(ScipOptions)
def connect(context: Context, options: dict[str, Any]) -> Scip:
    """Entry point `scip:scanner`."""
    device = Scip(context, read_options(context, options, ScipOptions))
    device.join()
    return device
