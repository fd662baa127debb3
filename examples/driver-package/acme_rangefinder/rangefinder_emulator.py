"""Emulator of rangefinder, backed by any device of kind proximity."""

from __future__ import annotations

from typing import Any

from acme_rangefinder.rangefinder import FRAME, HEADER, RATE_HZ
from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import PtyPort
from drivers.transport.checks import sum_low_byte
from hal.devices import Device, Proximity
from hal.errors import Unsupported
from hal.strict import validate


class RangefinderEmulator(WireEmulator):
    """Running emulator at the other end of the driver's link."""

    period_s = 1.0 / RATE_HZ

    def __init__(self, backing: Proximity, options: FaultOptions) -> None:
        super().__init__(PtyPort("rangefinder"), options, name="rangefinder")
        self._backing = backing
        self._counter = 0

    def on_tick(self) -> None:
        """Send one frame with the newest sample of the backing device."""
        sample = self._backing.read_distance_m(deadline=self.deadline())
        values = [sample.value]
        numbers = [round(1000.0 * value) for value in values]
        self._counter = (self._counter + 1) % 256
        body = FRAME.pack(HEADER, self._counter, *numbers, 0)[:-1]
        self.send(None, body + bytes([sum_low_byte(body)]))


def start(backing: Device, options: dict[str, Any]) -> RangefinderEmulator:
    """Entry point `rangefinder` in the group `panelwright.emulators`."""
    if not isinstance(backing, Proximity):
        raise Unsupported(
            f"the emulator of rangefinder cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind proximity as the emulator's backing device",
        )
    emulator = RangefinderEmulator(backing, validate(options, FaultOptions, source="emulators.rangefinder"))
    emulator.begin()
    return emulator
