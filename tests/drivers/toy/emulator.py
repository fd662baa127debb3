"""Emulator of the toy rangefinder, written from its manual and not from the driver."""

from __future__ import annotations

import math
from functools import reduce
from operator import xor
from typing import Any

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from hal.devices import Proximity
from hal.strict import validate


class ToyEmulator(WireEmulator):
    """Running emulator: a power-up sends nothing until `GO`."""

    period_s = 0.02

    def __init__(self, backing: Proximity, options: FaultOptions) -> None:
        super().__init__(PtyPort("toy"), options, name="toy")
        self._backing = backing
        self._heard = b""
        self._counter = 0
        self.is_streaming = False

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Obey each complete command."""
        *commands, self._heard = (self._heard + data).split(b"\n")
        for command in commands:
            if command in (b"GO", b"STOP"):
                self.is_streaming = command == b"GO"
            elif command == b"ID?":
                self.reply(peer, b"RF7 1.2\n")

    def on_tick(self) -> None:
        """Send one line."""
        if self.is_streaming:
            distance_m = self._backing.read_distance_m(deadline=self.deadline()).value
            self._counter = (self._counter + 1) % 256
            strength, tenths_mm = (0, 0) if math.isnan(distance_m) else (90, round(10_000 * distance_m))
            body = f"D,{self._counter:03},{tenths_mm:05},{strength:03}".encode()
            self.send(None, b"$" + body + f"*{reduce(xor, body):02X}\n".encode())


def start(backing: Proximity, options: dict[str, Any]) -> ToyEmulator:
    """Start the emulator."""
    emulator = ToyEmulator(backing, validate(options, FaultOptions, source="toy"))
    emulator.begin()
    return emulator
