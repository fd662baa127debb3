"""Slamtec RPLIDAR on a pty, seeing what a range scanner of any kind sees."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.rplidar import descriptor
from hal.devices import Device, RangeScanner
from hal.errors import Unsupported
from hal.strict import validate

QUALITY = 15


class RplidarEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    scan_rate_hz: Annotated[float, Field(gt=0, le=50)] = 10.0
    nodes: Annotated[int, Field(ge=36, le=3600)] = 360
    health: Annotated[int, Field(ge=0, le=2)] = 0
    is_cured_by_reset: bool = True


class RplidarEmulator(WireEmulator):
    """The scanner, running; a turn goes out in one piece."""

    def __init__(self, backing: RangeScanner, options: RplidarEmulatorOptions) -> None:
        super().__init__(PtyPort("rplidar"), options, name="rplidar")
        self._backing = backing
        self._o = options
        self.health = options.health
        self.period_s = 1.0 / options.scan_rate_hz
        self.is_scanning = False
        self._buffer = b""

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Requests `A5 command`."""
        self._buffer += data
        while (at := self._buffer.find(b"\xa5")) >= 0 and len(self._buffer) > at + 1:
            command, self._buffer = self._buffer[at + 1], self._buffer[at + 2 :]
            self._request(peer, command)

    def _request(self, peer: Peer, command: int) -> None:
        match command:
            case 0x25:
                self.is_scanning = False
            case 0x40:
                self.is_scanning = False
                self.health = 0 if self._o.is_cured_by_reset else self.health
                self.reply(peer, b"RP LIDAR System.\r\n")
            case 0x50:
                self.reply(peer, descriptor(20, 0, 4) + bytes([24, 29, 1, 7]) + bytes(range(16)))
            case 0x52:
                self.reply(peer, descriptor(3, 0, 6) + bytes([self.health, 0, 0]))
            case 0x20 | 0x21 if self.health != 2:
                self.is_scanning = True
                self.reply(peer, descriptor(5, 1, 0x81))
            case _:
                return

    def on_tick(self) -> None:
        """One turn."""
        if self.is_scanning:
            self.send(None, self._turn(), protected=slice(0, 0))

    def _turn(self) -> bytes:
        angle_rad = np.arange(self._o.nodes, dtype=np.float64) * (2.0 * np.pi / self._o.nodes)
        seen = self._backing.read_range(deadline=self.deadline()).value
        signed_rad = (angle_rad + np.pi) % (2.0 * np.pi) - np.pi
        range_m = line_m(seen, self._backing.capabilities(), signed_rad)
        return encode_turn(angle_rad, range_m)


def encode_turn(angle_rad: np.ndarray[Any, Any], range_m: np.ndarray[Any, Any]) -> bytes:
    """Five bytes a measurement; the first has the start flag."""
    angle_q6 = np.round(np.degrees(angle_rad) * 64.0).astype(np.int64)
    distance_q2 = np.round(np.nan_to_num(range_m) * 4000.0).astype(np.int64)
    is_start = np.arange(len(angle_rad)) == 0
    nodes = np.stack(
        [
            QUALITY << 2 | np.where(is_start, 1, 2),
            (angle_q6 << 1 & 0xFF) | 1,
            angle_q6 >> 7,
            distance_q2 & 0xFF,
            distance_q2 >> 8,
        ],
        axis=1,
    )
    return nodes.astype(np.uint8).tobytes()


def start(backing: Device, options: dict[str, Any]) -> RplidarEmulator:
    """Entry point `rplidar`."""
    if not isinstance(backing, RangeScanner):
        raise Unsupported(f"a scanner cannot stand for a {backing.kind}", hint="back it with a range scanner")
    emulator = RplidarEmulator(backing, validate(options, RplidarEmulatorOptions, source="emulators.rplidar"))
    emulator.begin()
    return emulator
