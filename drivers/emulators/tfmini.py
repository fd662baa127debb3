"""Emulated Benewake TFmini-Plus: sends 100 frames per second from any proximity device and answers commands."""

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
    """Running emulator of the sensor, on a pty."""

    def __init__(self, backing: Proximity, options: TfminiEmulatorOptions) -> None:
        super().__init__(PtyPort("tfmini"), options, name="tfmini")
        self._backing = backing
        self._commands = Framer(b"\x5a", lambda d: None if len(d) < 2 else d[1], _sum_is_right)
        self.period_s = 1.0 / options.rate_hz
        self.is_mm = False

    def on_tick(self) -> None:
        """Send one measurement."""
        sample = self._backing.read_distance_m(deadline=self.deadline())
        is_seen = sample.quality is not Quality.INVALID
        per_m = 1000.0 if self.is_mm else 100.0
        raw = min(0xFFFF, round(sample.value * per_m)) if is_seen else 0
        self.send(None, data_frame(raw, STRONG if is_seen else WEAK))

    def status_frame(self) -> bytes | None:
        """Return a frame with too weak a signal, by which the sensor marks a distance as invalid."""
        return data_frame(0, WEAK)

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Carry out the commands for version, rate, unit, output and save."""
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
    """Return one frame: `59 59`, distance, strength and temperature of 16 bits each, 8-bit checksum."""
    body = b"\x59\x59" + struct.pack("<HHH", raw, strength, TEMPERATURE_RAW)
    return body + bytes([sum_low_byte(body)])


def _sum_is_right(frame: bytes) -> bool:
    return len(frame) >= 4 and sum_low_byte(frame[:-1]) == frame[-1]


def start(backing: Device, options: dict[str, Any]) -> TfminiEmulator:
    """Start the emulator on a proximity device (entry point `tfmini`)."""
    if not isinstance(backing, Proximity):
        raise Unsupported(
            f"the emulator of a TFmini distance sensor cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind proximity as the emulator's backing device",
        )
    emulator = TfminiEmulator(backing, validate(options, TfminiEmulatorOptions, source="emulators.tfmini"))
    emulator.begin()
    return emulator
