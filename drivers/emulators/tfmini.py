"""Benewake TFmini-Plus: 100 frames a second with what a proximity device of any backend measures; answers commands."""

from __future__ import annotations

import struct
from typing import Annotated, Any

from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.transport.checks import sum_low_byte
from drivers.transport.framing import Framer
from hal.devices import Device, Proximity
from hal.errors import Unsupported
from hal.readings import Quality
from hal.strict import validate

STRONG, WEAK = 2000, 0
TEMPERATURE_RAW = (25 + 256) * 8
UNIT_MM = 6


class TfminiEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0


class TfminiEmulator(WireEmulator):
    """The sensor, running on a pty."""

    def __init__(self, backing: Proximity, options: TfminiEmulatorOptions) -> None:
        super().__init__(PtyPort("tfmini"), options, name="tfmini")
        self._backing = backing
        self._commands = Framer(b"\x5a", lambda d: None if len(d) < 2 else d[1], _sum_is_right)
        self.period_s = 1.0 / options.rate_hz
        self.is_mm = False

    def on_tick(self) -> None:
        """One measurement."""
        sample = self._backing.read_distance_m(deadline=self.deadline())
        is_seen = sample.quality is not Quality.INVALID
        per_m = 1000.0 if self.is_mm else 100.0
        raw = min(0xFFFF, round(sample.value * per_m)) if is_seen else 0
        self.send(None, data_frame(raw, STRONG if is_seen else WEAK))

    def status_frame(self) -> bytes | None:
        """Too weak a signal: the sensor's way to say that the distance is no distance."""
        return data_frame(0, WEAK)

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Commands: version, rate, unit, output, save."""
        for frame in self._commands.feed(data):
            answer = self._carry_out(frame[2], frame[3:-1])
            if answer:
                self.reply(peer, answer + bytes([sum_low_byte(answer)]))

    def _carry_out(self, command: int, payload: bytes) -> bytes:
        match command:
            case 0x01:
                return bytes([0x5A, 7, 1, 4, 0, 2])
            case 0x03:
                rate_hz = struct.unpack("<H", payload)[0]
                self.period_s = 1.0 / rate_hz if rate_hz else None
            case 0x05:
                self.is_mm = payload[0] == UNIT_MM
            case 0x07:
                pass
            case _:
                return bytes([0x5A, 5, command, 0])
        return bytes([0x5A, 4 + len(payload), command]) + payload


def data_frame(raw: int, strength: int) -> bytes:
    """`59 59 dist16 strength16 temp16 sum8`."""
    body = b"\x59\x59" + struct.pack("<HHH", raw, strength, TEMPERATURE_RAW)
    return body + bytes([sum_low_byte(body)])


def _sum_is_right(frame: bytes) -> bool:
    return len(frame) >= 4 and sum_low_byte(frame[:-1]) == frame[-1]


def start(backing: Device, options: dict[str, Any]) -> TfminiEmulator:
    """Entry point `tfmini`."""
    if not isinstance(backing, Proximity):
        raise Unsupported(f"a tfmini cannot stand for a {backing.kind}", hint="back it with a proximity device")
    emulator = TfminiEmulator(backing, validate(options, TfminiEmulatorOptions, source="emulators.tfmini"))
    emulator.begin()
    return emulator
