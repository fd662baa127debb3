"""Emulated Benewake TFmini-i on a pty, as a Modbus slave or behind an slcan adapter, backed by any proximity device."""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.can_port import CanLines, VirtualCanPort, can_address
from drivers.emulators.faults import FaultOptions
from drivers.emulators.modbus_server import ModbusFarSide, RegistersOnly, no_such
from drivers.emulators.ports import Peer, PtyPort
from drivers.transport.can_frames import CanFrame
from hal.clock import Deadline, WallClock
from hal.devices import Device, Proximity
from hal.errors import Unsupported
from hal.readings import Quality
from hal.strict import validate

UNIT, CAN_ID = 1, 3
STRONG, WEAK = 2000, 0
FIRMWARE = (0x0001, 0x0203)
ADDRESS_SAVE, ADDRESS_LAST_SETTING = 0x80, 0x86
BACKING_S = 0.2


class TfminiIOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    clock_start_ms: Annotated[int, Field(ge=0, lt=1 << 32)] = 0


class CanTfminiIOptions(TfminiIOptions):
    """`[emulators.NAME.emulator_options]` on a CAN bus."""

    transport: Literal["serial", "virtual"] = "serial"


class Measurement:
    """Newest measurement: distance in cm, strength, and the sensor's clock in ms at the time of the measurement."""

    def __init__(self, backing: Proximity, options: TfminiIOptions) -> None:
        self._backing = backing
        self._clock_start_ms = options.clock_start_ms
        self._start_s = time.monotonic()
        self._clock = WallClock()
        self._newest: tuple[int, int, int] | None = None

    @property
    def newest(self) -> tuple[int, int, int]:
        """Return the last measurement; the first one is made when it is asked for."""
        return self._newest or self.renew()

    def renew(self) -> tuple[int, int, int]:
        """Measure, and return distance (cm), strength and clock (ms)."""
        passed_ms = round((time.monotonic() - self._start_s) * 1000.0)
        sample = self._backing.read_distance_m(deadline=Deadline.after(self._clock, BACKING_S))
        is_seen = sample.quality is not Quality.INVALID
        stamp_ms = (self._clock_start_ms + passed_ms) & 0xFFFFFFFF
        self._newest = (round(sample.value * 100.0) if is_seen else 0, STRONG if is_seen else WEAK, stamp_ms)
        return self._newest


class TfminiITable(RegistersOnly):
    """Registers: 0-4 measurement and clock, 6-7 firmware version; writes to the settings 80h-86h have no effect."""

    def __init__(self, measurement: Measurement) -> None:
        self._measurement = measurement

    def registers(self, address: int, count: int) -> Sequence[int]:
        """Return registers of measurement, clock and firmware version."""
        raw, strength, stamp_ms = self._measurement.newest
        words = (raw, strength, 0, stamp_ms >> 16, stamp_ms & 0xFFFF, 0, *FIRMWARE)
        if address + count > len(words):
            raise no_such(address, count)
        return words[address : address + count]

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Accept save, restart, baud rate, unit and rate without effect."""
        if not ADDRESS_SAVE <= address <= ADDRESS_LAST_SETTING:
            raise no_such(address, *values)


class ModbusTfminiEmulator(ModbusFarSide):
    """Running emulator of the sensor on a serial bus; it measures at its own rate, and is asked for the newest result."""

    def __init__(self, measurement: Measurement, options: TfminiIOptions) -> None:
        super().__init__(PtyPort("tfmini"), options, TfminiITable(measurement), unit=UNIT, name="tfmini_modbus")
        self._measurement = measurement
        self.period_s = 1.0 / options.rate_hz

    def on_tick(self) -> None:
        """Measure."""
        self._measurement.renew()


class CanTfminiEmulator(WireEmulator):
    """Running emulator of the sensor behind an slcan adapter or on a virtual bus."""

    def __init__(self, measurement: Measurement, options: CanTfminiIOptions) -> None:
        is_virtual = options.transport == "virtual"
        super().__init__(VirtualCanPort("tfmini") if is_virtual else PtyPort("slcan"), options, name="tfmini_can")
        self._measurement = measurement
        self._lines = CanLines()
        self.is_open = is_virtual
        self.period_s = 1.0 / options.rate_hz

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options that lead to the bus."""
        return can_address(self.port)

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Carry out the adapter's commands to open and close the channel."""
        for line in data.split(b"\r"):
            if line[:1] in (b"O", b"C"):
                self.is_open = line[:1] == b"O"
            if line:
                self.reply(peer, b"\r")

    def on_tick(self) -> None:
        """Send one measurement while the channel is open."""
        if self.is_open:
            self.send(None, self._frame(*self._measurement.renew()), protected=slice(0, 0))

    def status_frame(self) -> bytes | None:
        """Return a frame with too weak a signal."""
        return self._frame(0, WEAK, self._measurement.newest[2])

    def _frame(self, raw: int, strength: int, stamp_ms: int) -> bytes:
        return self._lines.encode(CanFrame(CAN_ID, struct.pack("<HHI", raw, strength, stamp_ms)))


Options = TypeVar("Options", bound=TfminiIOptions)


def _measurement(backing: Device, options: dict[str, Any], model: type[Options]) -> tuple[Measurement, Options]:
    if not isinstance(backing, Proximity):
        raise Unsupported(
            f"the emulator of a TFmini-i distance sensor cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind proximity as the emulator's backing device",
        )
    parsed = validate(options, model, source="emulators.tfmini_i")
    return Measurement(backing, parsed), parsed


def start_modbus(backing: Device, options: dict[str, Any]) -> ModbusTfminiEmulator:
    """Start the Modbus emulator on a proximity device (entry point `tfmini_modbus`)."""
    emulator = ModbusTfminiEmulator(*_measurement(backing, options, TfminiIOptions))
    emulator.begin()
    return emulator


def start_can(backing: Device, options: dict[str, Any]) -> CanTfminiEmulator:
    """Start the CAN emulator on a proximity device (entry point `tfmini_can`)."""
    measurement, parsed = _measurement(backing, options, CanTfminiIOptions)
    emulator = CanTfminiEmulator(measurement, parsed)
    emulator.begin()
    return emulator
