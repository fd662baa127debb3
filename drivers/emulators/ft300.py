"""Emulated Robotiq FT 300 on a pty: Modbus registers and stream; any force/torque device supplies the wrench."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.emulators.faults import FaultOptions
from drivers.emulators.modbus_server import ModbusFarSide, RegistersOnly, no_such
from drivers.emulators.ports import Peer, PtyPort
from drivers.transport.checks import crc_modbus
from hal.clock import Deadline, WallClock
from hal.devices import Device, ForceTorque
from hal.errors import Unsupported
from hal.strict import validate

UNIT = 9
WRENCH, FIRMWARE, STREAM = 180, 500, 410
STOP_BYTES = 200  # this many consecutive FF bytes end the stream


def counts(backing: ForceTorque) -> list[int]:
    """Return the newest wrench as six signed counts, limited to 16 bits."""
    wrench = backing.read_wrench(deadline=Deadline.after(WallClock(), 0.2)).value
    scaled = np.concatenate((wrench.force_n * 100.0, wrench.torque_nm * 1000.0))
    return [int(c) for c in np.clip(np.round(scaled), -32768, 32767)]


class Ft300Table(RegistersOnly):
    """Registers: 180-185 wrench, 500-502 firmware version; writing 200h to 410 starts the stream."""

    def __init__(self, backing: ForceTorque) -> None:
        self.backing = backing
        self.is_streaming = False

    def registers(self, address: int, count: int) -> Sequence[int]:
        """Return registers of the wrench or of the firmware version."""
        if address >= FIRMWARE and address + count <= FIRMWARE + 3:
            return [1, 2, 3][address - FIRMWARE :][:count]
        if address >= WRENCH and address + count <= WRENCH + 6:
            return [c & 0xFFFF for c in counts(self.backing)][address - WRENCH :][:count]
        raise no_such(address, count)

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Start the stream; no other register can be written."""
        if address != STREAM or list(values) != [0x200]:
            raise no_such(address, *values)
        self.is_streaming = True


class Ft300Emulator(ModbusFarSide):
    """Running emulator of the sensor."""

    def __init__(self, backing: ForceTorque, options: FaultOptions) -> None:
        self.table = Ft300Table(backing)
        self._stop_bytes = 0
        self.period_s = 0.01
        super().__init__(PtyPort("ft300"), options, self.table, unit=UNIT, name="ft300")

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer requests; while streaming, only the sequence that ends the stream is recognised."""
        if not self.table.is_streaming:
            super().on_bytes(peer, data.lstrip(b"\xff"))
            return
        self._stop_bytes = self._stop_bytes + len(data) if set(data) == {0xFF} else 0
        if self._stop_bytes >= STOP_BYTES:
            self.table.is_streaming, self._stop_bytes = False, 0

    def on_tick(self) -> None:
        """Send one frame while streaming."""
        if self.table.is_streaming:
            self.send(None, stream_frame(counts(self.table.backing)))

    def status_frame(self) -> bytes | None:
        """Return a Modbus exception, or None while streaming, because the stream cannot report errors."""
        return None if self.table.is_streaming else super().status_frame()


def stream_frame(values: Sequence[int]) -> bytes:
    """Return one frame of the stream: `20 4E`, six signed 16-bit counts, CRC."""
    body = b"\x20\x4e" + struct.pack("<6h", *values)
    return body + struct.pack("<H", crc_modbus(body))


def start(backing: Device, options: dict[str, Any]) -> Ft300Emulator:
    """Start the emulator on a force/torque device (entry point `ft300`)."""
    if not isinstance(backing, ForceTorque):
        raise Unsupported(
            f"the emulator of an FT 300 force/torque sensor cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind force_torque as the emulator's backing device",
        )
    emulator = Ft300Emulator(backing, validate(options, FaultOptions, source="emulators.ft300"))
    emulator.begin()
    return emulator
