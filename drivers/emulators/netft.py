"""Emulated ATI Net F/T on loopback UDP; any force/torque device supplies the wrench."""

from __future__ import annotations

import struct
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, UdpPort
from hal.devices import Device, ForceTorque
from hal.errors import Unsupported
from hal.strict import validate

COUNTS = 1_000_000.0
STATUS_SATURATED = 0x80000000
INTERNAL_RATE_HZ = 7000


class NetftEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 250.0
    udp_port: Annotated[int, Field(ge=0, le=65535)] = 0


class NetftEmulator(WireEmulator):
    """Running emulator of the sensor."""

    def __init__(self, backing: ForceTorque, options: NetftEmulatorOptions) -> None:
        super().__init__(UdpPort(options.udp_port), options, name="netft")
        self._backing = backing
        self.period_s = 1.0 / options.rate_hz
        self._per_record = max(1, round(INTERNAL_RATE_HZ / options.rate_hz))
        self._peer: Peer | None = None
        self._left: int | None = None
        self._sequence = 0
        self._status = 0

    @property
    def is_streaming(self) -> bool:
        """Return whether a client has requested records."""
        return self._peer is not None

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Start or stop streaming on request."""
        if len(data) != 8:
            return
        header, command, count = struct.unpack(">HHI", data)
        if header != 0x1234:
            return
        if command in (1, 2, 3):
            self._peer, self._left, self._sequence = peer, count or None, 0
        elif command == 0:
            self._peer = None

    def on_tick(self) -> None:
        """Send one record while streaming."""
        if self._peer is None:
            return
        self._sequence += 1
        self.send(self._peer, self._record(0), protected=slice(0, 0))
        if self._left is not None:
            self._left -= 1
            if self._left <= 0:
                self._peer = None

    def status_frame(self) -> bytes | None:
        """Return a record with the status for saturation."""
        return self._record(STATUS_SATURATED)

    def _record(self, status: int) -> bytes:
        w = self._backing.read_wrench(deadline=self.deadline()).value
        scaled = np.clip(np.round(np.concatenate((w.force_n, w.torque_nm)) * COUNTS), -(2**31), 2**31 - 1)
        counts = [int(c) for c in scaled]
        return struct.pack(">III6i", self._sequence, self._sequence * self._per_record, status, *counts)


def start(backing: Device, options: dict[str, Any]) -> NetftEmulator:
    """Start the emulator on a force/torque device (entry point `netft`)."""
    if not isinstance(backing, ForceTorque):
        raise Unsupported(
            f"the emulator of a Net F/T sensor cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind force_torque as the emulator's backing device",
        )
    emulator = NetftEmulator(backing, validate(options, NetftEmulatorOptions, source="emulators.netft"))
    emulator.begin()
    return emulator
