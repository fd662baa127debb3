"""Emulated SICK LMS 200 on a pty; any range scanner supplies the distances."""

from __future__ import annotations

import struct
import termios
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.lms200 import framer, telegram
from hal.devices import Device, RangeScanner
from hal.errors import Unsupported
from hal.strict import validate

BAUDS = {0x42: 9600, 0x41: 19_200, 0x40: 38_400, 0x48: 500_000}
SPEEDS = {9600: termios.B9600, 19_200: termios.B19200, 38_400: termios.B38400, 500_000: termios.B500000}
CODE_DAZZLED = 0x1FFE
WELL, FATAL = 0x10, 0x14
ACK, NAK = b"\x06", b"\x15"


class Lms200EmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    scan_s: Annotated[float, Field(gt=0)] = 0.03
    power_up_baud: int = 9600


class Lms200Emulator(WireEmulator):
    """Running emulator of the scanner; it understands only what is sent at its own baud rate."""

    def __init__(self, backing: RangeScanner, options: Lms200EmulatorOptions) -> None:
        self._pty = PtyPort("lms200")
        super().__init__(self._pty, options, name="lms200")
        self._backing = backing
        self.period_s = options.scan_s
        self.baud = options.power_up_baud
        self.is_streaming = False
        self.is_set_up = False
        self.field_deg, self.step_deg = 180, 1.0
        self.config = bytearray(34)
        self._requests = framer(0)

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer the telegrams sent at the current baud rate; at any other rate the bytes are noise."""
        if self._pty.speed() != SPEEDS[self.baud]:
            self._requests.reset()
            return
        for request in self._requests.feed(data):
            self.reply(peer, ACK)
            answer = self._answer(request[4:-2])
            self.reply(peer, telegram(answer + bytes([WELL]), address=0x80))
            if request[4] == 0x20 and request[5] in BAUDS:
                self.baud = BAUDS[request[5]]

    def _answer(self, payload: bytes) -> bytes:
        match payload[0]:
            case 0x20:
                self.is_streaming = payload[1] == 0x24
                self.is_set_up = payload[1] == 0x00 and payload[2:] == b"SICK_LMS"
                return b"\xa0\x00"
            case 0x3B:
                self.field_deg, step = struct.unpack("<HH", payload[1:5])
                self.step_deg = step / 100.0
                return b"\xbb\x01" + payload[1:5]
            case 0x74:
                return b"\xf4" + bytes(self.config)
            case 0x77 if self.is_set_up:
                self.config = bytearray(payload[1:])
                return b"\xf7\x01" + bytes(self.config)
            case 0x30:
                return self._scan()
            case _:
                return b"\x92"

    def on_tick(self) -> None:
        """Send one scan while streaming."""
        if self.is_streaming:
            self.send(None, telegram(self._scan() + bytes([WELL]), address=0x80))

    def status_frame(self) -> bytes | None:
        """Return a scan whose status byte reports a fatal error."""
        return telegram(self._scan() + bytes([FATAL]), address=0x80)

    def _scan(self) -> bytes:
        count = round(self.field_deg / self.step_deg) + 1
        angle_rad = np.radians(np.arange(count) * self.step_deg - self.field_deg / 2.0)
        seen = self._backing.read_range(deadline=self.deadline()).value
        range_m = line_m(seen, self._backing.capabilities(), angle_rad)
        is_mm = self.config[6] == 1
        counts = np.nan_to_num(range_m) * (1000.0 if is_mm else 100.0)
        raw = np.where(np.isfinite(range_m), np.clip(np.round(counts), 0, 0x1FF6), CODE_DAZZLED).astype("<u2")
        return b"\xb0" + struct.pack("<H", count | (1 << 14 if is_mm else 0)) + raw.tobytes()


def start(backing: Device, options: dict[str, Any]) -> Lms200Emulator:
    """Start the emulator on a range scanner (entry point `lms200`)."""
    if not isinstance(backing, RangeScanner):
        raise Unsupported(
            f"the emulator of an LMS 200 scanner cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind range_scanner as the emulator's backing device",
        )
    emulator = Lms200Emulator(backing, validate(options, Lms200EmulatorOptions, source="emulators.lms200"))
    emulator.begin()
    return emulator
