"""Emulated Bota SensONE on a pty; any force/torque device supplies the wrench."""

from __future__ import annotations

import struct
import time
from typing import Annotated, Any

from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.transport.checks import crc_x25
from hal.devices import Device, ForceTorque, Wrench
from hal.errors import Unsupported
from hal.strict import validate

INVALID = 4
TEMPERATURE_C = 31.5


class BotaEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    clock_start_us: Annotated[int, Field(ge=0, lt=1 << 32)] = 0


class BotaEmulator(WireEmulator):
    """Running emulator of the sensor."""

    def __init__(self, backing: ForceTorque, options: BotaEmulatorOptions) -> None:
        super().__init__(PtyPort("bota"), options, name="bota")
        self._backing = backing
        self._clock_start_us = options.clock_start_us
        self._start_s = time.monotonic()
        self.period_s = 0.01
        self.is_running = True

    def stamp_us(self) -> int:
        """Return the sensor's 32-bit clock, in microseconds."""
        return (self._clock_start_us + int((time.monotonic() - self._start_s) * 1e6)) & 0xFFFFFFFF

    def restart(self) -> None:
        """Act as after power-up: announce it and wait in set-up mode."""
        self.is_running = False
        self.reply(None, b"App Init\r\n")

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Carry out the commands; each arrives in one piece, with or without a line end."""
        for line in data.split():
            self._command(peer, line)

    def _command(self, peer: Peer, line: bytes) -> None:
        code, *numbers = line.decode("ascii", "replace").split(",")
        if code == "C":
            self.is_running = False
        elif code == "R":
            self.is_running = True
        elif code == "f" and not self.is_running and len(numbers) == 4:
            self.period_s = int(numbers[0]) * 19.53125e-6
        elif code != "c" or self.is_running:
            return
        self.reply(peer, f"r,0,{code},0\r\n".encode())

    def on_tick(self) -> None:
        """Send one frame while running."""
        if self.is_running:
            self.send(None, self._frame(0))

    def status_frame(self) -> bytes | None:
        """Return a frame with the status bit for invalid data."""
        return self._frame(INVALID)

    def _frame(self, status: int) -> bytes:
        return frame(self._backing.read_wrench(deadline=self.deadline()).value, status, self.stamp_us())


def frame(wrench: Wrench, status: int, stamp_us: int) -> bytes:
    """Return one frame: AA, u16 status, six f32 of force and torque, u32 microseconds, f32 degrees Celsius, CRC."""
    body = struct.pack("<H6fIf", status, *wrench.force_n, *wrench.torque_nm, stamp_us, TEMPERATURE_C)
    return b"\xaa" + body + struct.pack("<H", crc_x25(body))


def start(backing: Device, options: dict[str, Any]) -> BotaEmulator:
    """Start the emulator on a force/torque device (entry point `bota`)."""
    if not isinstance(backing, ForceTorque):
        raise Unsupported(
            f"the emulator of a SensONE force/torque sensor cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind force_torque as the emulator's backing device",
        )
    emulator = BotaEmulator(backing, validate(options, BotaEmulatorOptions, source="emulators.bota"))
    emulator.begin()
    return emulator
