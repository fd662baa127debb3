"""Emulated Slamtec RPLIDAR on a pty; any range scanner supplies the distances."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.beams import line_m
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.rplidar.express import CABIN, CAPSULE_BYTES, POINTS
from drivers.rplidar.nodes import NODE_BYTES
from drivers.rplidar.scanner import descriptor
from drivers.transport.checks import xor_byte
from hal.devices import Device, RangeScanner
from hal.errors import Unsupported
from hal.strict import validate

QUALITY = 15
WITH_PAYLOAD = 0x80


class RplidarEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    scan_rate_hz: Annotated[float, Field(gt=0, le=50)] = 10.0
    nodes: Annotated[int, Field(ge=36, le=3600)] = 360
    bursts: Annotated[int, Field(ge=1, le=360, description="pieces in which a revolution is sent; faults hit one")] = 1
    is_rotating: Annotated[
        bool,
        Field(description="each burst is measured when it is sent; otherwise the revolution at its start, all at once"),
    ] = False
    health: Annotated[int, Field(ge=0, le=2)] = 0
    is_cured_by_reset: bool = True


class RplidarEmulator(WireEmulator):
    """Running emulator of the scanner; it sends each revolution in bursts."""

    def __init__(self, backing: RangeScanner, options: RplidarEmulatorOptions) -> None:
        super().__init__(PtyPort("rplidar"), options, name="rplidar")
        self._backing = backing
        self._o = options
        self.health = options.health
        self.period_s = 1.0 / options.scan_rate_hz / options.bursts
        self.is_scanning = self.is_express = self._is_first = False
        self._buffer = b""
        self._unsent: list[bytes] = []
        self._sent_ratio = self._step_ratio = 0.0  # of the present revolution; of one burst

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer the requests; each is `A5 command`, some with a payload."""
        self._buffer += data
        while (at := self._buffer.find(b"\xa5")) >= 0 and len(self._buffer) > at + 1:
            command, rest = self._buffer[at + 1], self._buffer[at + 2 :]
            payload = 1 + rest[0] + 1 if command >= WITH_PAYLOAD and rest else 0  # length byte, payload, checksum
            if len(rest) < payload or (command >= WITH_PAYLOAD and not rest):
                return
            self._buffer = rest[payload:]
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
            case 0x82 if self.health != 2:
                self.is_scanning, self.is_express, self._is_first = True, True, True
                self.reply(peer, descriptor(CAPSULE_BYTES, 1, 0x82))
            case 0x20 | 0x21 if self.health != 2:
                self.is_scanning, self.is_express = True, False
                self.reply(peer, descriptor(5, 1, 0x81))
            case _:
                return

    def on_tick(self) -> None:
        """Send one burst while scanning."""
        if not self.is_scanning:
            self._unsent = []
            return
        begun = self._sent_ratio if self._unsent else 0.0
        # A rotating head measures as it goes; behind it, from a quarter to three quarters, the backing device sees nothing.
        if begun == 0.0 or (self._o.is_rotating and not 0.25 < begun < 0.75 - self._step_ratio):
            turn, unit = self._turn(), CAPSULE_BYTES if self.is_express else NODE_BYTES
            size = -(-len(turn) // unit // self._o.bursts) * unit
            pieces = [turn[at : at + size] for at in range(0, len(turn), size)]
            self._unsent = pieces[round(begun * len(pieces)) :]
            self._step_ratio = 1.0 / len(pieces)
        self._sent_ratio = begun + self._step_ratio
        self.send(None, self._unsent.pop(0), protected=slice(None) if self.is_express else slice(0, 0))

    def _turn(self) -> bytes:
        count = self._o.nodes if not self.is_express else -(-self._o.nodes // POINTS) * POINTS
        angle_rad = np.arange(count, dtype=np.float64) * (2.0 * np.pi / count)
        seen = self._backing.read_range(deadline=self.deadline()).value
        signed_rad = (angle_rad + np.pi) % (2.0 * np.pi) - np.pi
        range_m = line_m(seen, self._backing.capabilities(), signed_rad)
        if not self.is_express:
            return encode_turn(angle_rad, range_m)
        is_first, self._is_first = self._is_first, False
        return encode_capsules(range_m, is_first=is_first)


def encode_turn(angle_rad: np.ndarray[Any, Any], range_m: np.ndarray[Any, Any]) -> bytes:
    """Return a revolution as standard nodes of five bytes per measurement; the first has the start flag."""
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


def encode_capsules(range_m: np.ndarray[Any, Any], *, is_first: bool) -> bytes:
    """Return a revolution as express capsules: evenly spaced, a multiple of 32 measurements, no angle corrections."""
    raw = np.round(np.nan_to_num(range_m) * 1000.0).astype(np.int64) << 2
    capsules = b""
    for at in range(0, len(raw), POINTS):
        start_q6 = round(360.0 * at / len(raw) * 64.0) | (0x8000 if is_first and at == 0 else 0)
        cabins = np.zeros(POINTS // 2, CABIN)
        cabins["d1"], cabins["d2"] = raw[at : at + POINTS : 2], raw[at + 1 : at + POINTS : 2]
        body = start_q6.to_bytes(2, "little") + cabins.tobytes()
        check = xor_byte(body)
        capsules += bytes([0xA0 | check & 15, 0x50 | check >> 4]) + body
    return capsules


def start(backing: Device, options: dict[str, Any]) -> RplidarEmulator:
    """Start the emulator on a range scanner (entry point `rplidar`)."""
    if not isinstance(backing, RangeScanner):
        raise Unsupported(
            f"the emulator of an RPLIDAR scanner cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind range_scanner as the emulator's backing device",
        )
    emulator = RplidarEmulator(backing, validate(options, RplidarEmulatorOptions, source="emulators.rplidar"))
    emulator.begin()
    return emulator
