"""Emulated Hokuyo scanner (by default a URG-04LX) on a pty or TCP; any range scanner supplies the distances."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort, TcpPort
from drivers.transport.checks import sum_scip
from hal.devices import Device, RangeScanner
from hal.errors import Unsupported
from hal.strict import validate

LINE_CHARACTERS = 64
STAMP_MASK = (1 << 24) - 1


class ScipEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    transport: Literal["tcp", "serial"] = "tcp"
    tcp_port: Annotated[int, Field(ge=0, le=65535)] = 0
    first_step: int = 44
    last_step: int = 725
    front_step: int = 384
    steps_per_turn: int = 1024
    min_mm: int = 20
    max_mm: int = 4095
    scans_per_minute: Annotated[int, Field(ge=60, le=6000)] = 600
    clock_start_ms: Annotated[int, Field(ge=0)] = 0


class ScipEmulator(WireEmulator):
    """Running emulator of the scanner."""

    def __init__(self, backing: RangeScanner, options: ScipEmulatorOptions) -> None:
        port = PtyPort("scip") if options.transport == "serial" else TcpPort(options.tcp_port)
        super().__init__(port, options, name="scip")
        self._backing = backing
        self._o = options
        self.period_s = 60.0 / options.scans_per_minute
        self._buffers: dict[Peer, bytes] = {}
        self._is_lit = False
        self._stream: tuple[Peer, str] | None = None
        self._left: int | None = None
        self._start_s = time.monotonic()

    def stamp_ms(self) -> int:
        """Return the scanner's 24-bit clock, in milliseconds."""
        return (self._o.clock_start_ms + int((time.monotonic() - self._start_s) * 1000.0)) & STAMP_MASK

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Carry out the commands, one per line."""
        *lines, self._buffers[peer] = (self._buffers.get(peer, b"") + data).split(b"\n")
        for line in lines:
            if line:
                self._command(peer, line.decode("ascii", "replace"))

    def on_tick(self) -> None:
        """Send one scan while streaming."""
        if self._stream is None:
            return
        peer, echo = self._stream
        if self._left is not None:
            self._left -= 1
            echo = echo[:-2] + f"{self._left:02d}"
            if self._left <= 0:
                self._stream = None
        self.send(peer, self._scan(echo, "99"))

    def status_frame(self) -> bytes | None:
        """Return a message with status 72, hardware trouble."""
        echo = self._stream[1] if self._stream is not None else "MD"
        return _message(echo, "72")

    def _command(self, peer: Peer, line: str) -> None:
        match line[:2]:
            case "QT":
                self._stream, self._is_lit = None, False
                self.reply(peer, _message(line, "00"))
            case "BM":
                self.reply(peer, _message(line, "02" if self._is_lit else "00"))
                self._is_lit = True
            case "PP":
                self.reply(peer, _listing(line, self._parameters()))
            case "VV":
                self.reply(peer, _listing(line, {"VEND": "panelwright emulator", "PROT": "SCIP 2.0"}))
            case "MD":
                self._left = int(line[13:15]) or None
                self._stream, self._is_lit = (peer, line), True
                self.reply(peer, _message(line, "00"))
            case "GD":
                self.reply(peer, self._scan(line, "00") if self._is_lit else _message(line, "10"))
            case _:
                self.reply(peer, _message(line, "0E"))

    def _parameters(self) -> dict[str, str | int]:
        o = self._o
        return {
            "MODL": "URG-04LX",
            "DMIN": o.min_mm,
            "DMAX": o.max_mm,
            "ARES": o.steps_per_turn,
            "AMIN": o.first_step,
            "AMAX": o.last_step,
            "AFRT": o.front_step,
            "SCAN": o.scans_per_minute,
        }

    def _scan(self, echo: str, status: str) -> bytes:
        first, last, cluster = int(echo[2:6]), int(echo[6:10]), int(echo[10:12])
        steps = np.arange(first, last + 1, max(1, cluster))
        angle_rad = (steps - self._o.front_step).astype(np.float64) * (2.0 * np.pi / self._o.steps_per_turn)
        seen = self._backing.read_range(deadline=self.deadline()).value
        range_m = line_m(seen, self._backing.capabilities(), angle_rad)
        range_mm = np.where(np.isfinite(range_m), np.round(np.nan_to_num(range_m) * 1000.0), 0).astype(np.int64)
        data = encode_ranges(np.clip(range_mm, 0, self._o.max_mm))
        lines = [data[i : i + LINE_CHARACTERS] for i in range(0, len(data), LINE_CHARACTERS)]
        return _message(echo, status, [encode_number(self.stamp_ms(), 4), *lines])


def encode_number(value: int, characters: int) -> bytes:
    """Return the number in SCIP encoding: six bits per character, high bits first, plus 30h."""
    return bytes((value >> 6 * i & 0x3F) + 0x30 for i in range(characters - 1, -1, -1))


def encode_ranges(range_mm: NDArray[np.int64]) -> bytes:
    """Return the distances in SCIP encoding, three characters each."""
    shifted = np.stack([range_mm >> 12 & 0x3F, range_mm >> 6 & 0x3F, range_mm & 0x3F], axis=1)
    return (shifted + 0x30).astype(np.uint8).tobytes()


def _message(echo: str, status: str, lines: Iterable[bytes] = ()) -> bytes:
    return (
        b"\n".join([echo.encode(), *(line + bytes([sum_scip(line)]) for line in (status.encode(), *lines))]) + b"\n\n"
    )


def _listing(echo: str, values: Mapping[str, str | int]) -> bytes:
    """Return lines `KEY:value;` whose checksum leaves out the `;`, because other clients require it."""
    lines = [f"{key}:{value}".encode() for key, value in values.items()]
    summed = [b"00" + bytes([sum_scip(b"00")]), *(line + b";" + bytes([sum_scip(line)]) for line in lines)]
    return b"\n".join([echo.encode(), *summed]) + b"\n\n"


def start(backing: Device, options: dict[str, Any]) -> ScipEmulator:
    """Start the emulator on a range scanner (entry point `scip`)."""
    if not isinstance(backing, RangeScanner):
        raise Unsupported(
            f"the emulator of a SCIP scanner cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind range_scanner as the emulator's backing device",
        )
    emulator = ScipEmulator(backing, validate(options, ScipEmulatorOptions, source="emulators.scip"))
    emulator.begin()
    return emulator
