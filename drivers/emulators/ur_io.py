"""Emulated digital inputs and outputs of a UR controller on loopback RTDE, backed by any lights or touch pads."""

from __future__ import annotations

import struct
import time
from typing import Any

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, TcpPort
from drivers.emulators.ur import PortNumber
from drivers.ur import rtde
from hal.devices import Device, Lights, Touch
from hal.errors import Unsupported
from hal.strict import validate

TYPES = {
    "timestamp": "DOUBLE",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    # What general clients set up besides; it changes nothing here.
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
}
VERSION = (5, 11, 0, 0)  # of the controller: major, minor, bugfix, build
PERIOD_S = 0.008
FIRST_TOOL_INPUT = 16


class UrIoEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    port: PortNumber = 0  # 0: any free port; a real controller uses 30004


class UrIoEmulator(WireEmulator):
    """Running emulator of the controller."""

    def __init__(self, backing: Lights | Touch, options: UrIoEmulatorOptions) -> None:
        super().__init__(TcpPort(options.port), options, name="ur_io")
        self._backing = backing
        self.period_s = PERIOD_S
        self._start_s = time.monotonic()
        self._parsers: dict[Peer, rtde.PackageParser] = {}
        self._recipes: dict[tuple[Peer, str, int], rtde.Recipe] = {}
        self._streams: set[Peer] = set()
        self.outputs = 0

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer the RTDE packages."""
        if not data:
            self._parsers[peer] = rtde.PackageParser()
            self._streams.discard(peer)
            self._recipes = {known: recipe for known, recipe in self._recipes.items() if known[0] != peer}
        for kind, payload in self._parsers.setdefault(peer, rtde.PackageParser()).feed(data):
            self._obey(peer, kind, payload)

    def _obey(self, peer: Peer, kind: str, payload: bytes) -> None:
        match kind:
            case "V":
                self.reply(peer, rtde.package("V", bytes([payload == b"\x00\x02"])))
            case "v":
                self.reply(peer, rtde.package("v", struct.pack(">4I", *VERSION)))
            case "O" | "I":
                self._set_up(peer, kind, rtde.split_names(payload[8:] if kind == "O" else payload))
            case "S" | "P":
                (self._streams.add if kind == "S" else self._streams.discard)(peer)
                self.reply(peer, rtde.package(kind, b"\x01"))
            case "U" if (peer, "I", payload[0]) in self._recipes:
                self._switch(self._recipes[peer, "I", payload[0]].unpack(payload))

    def _set_up(self, peer: Peer, kind: str, names: tuple[str, ...]) -> None:
        """Confirm a recipe; a client may set up several for what it sends."""
        number = 1 + sum(known[:2] == (peer, kind) for known in self._recipes) if kind == "I" else 1
        types = [TYPES.get(name, "NOT_FOUND") for name in names]
        if "NOT_FOUND" not in types:
            self._recipes[peer, kind, number] = rtde.recipe(number, names, types)
        self.reply(peer, rtde.package(kind, bytes([number]) + ",".join(types).encode() + b","))

    def _switch(self, values: dict[str, Any]) -> None:
        mask, word = values.get("standard_digital_output_mask", 0), values.get("standard_digital_output", 0)
        self.outputs = self.outputs & ~mask | word & mask
        if isinstance(self._backing, Lights):
            count = len(self._backing.capabilities().channels)
            lit = [bool(self.outputs >> i & 1) for i in range(count)]
            self._backing.set_on(lit, deadline=self.deadline())

    def on_tick(self) -> None:
        """Send one data package to each client."""
        for peer in list(self._streams):
            self.send(peer, self._package(peer), protected=slice(0, 3))

    def status_frame(self) -> bytes | None:
        """Return a text message, which a controller may send at any time."""
        return rtde.package("M", struct.pack(">B5sB3s", 5, b"joint", 3, b"rtc") + b"\x00")

    def _package(self, peer: Peer) -> bytes:
        values: dict[str, float | int] = {
            "timestamp": time.monotonic() - self._start_s,
            "actual_digital_input_bits": self._inputs(),
            "actual_digital_output_bits": self.outputs,
        }
        recipe = self._recipes[peer, "O", 1]
        return recipe.pack([values[name] for name in recipe.names])

    def _inputs(self) -> int:
        if isinstance(self._backing, Lights):
            bits, first = self._backing.read_on(deadline=self.deadline()).value, 0
        else:
            bits, first = self._backing.read_contacts(deadline=self.deadline()).value, FIRST_TOOL_INPUT
        return sum(1 << first + i for i, is_on in enumerate(bits) if is_on)


def start(backing: Device, options: dict[str, Any]) -> UrIoEmulator:
    """Start the emulator on lights or touch pads (entry point `ur_io`)."""
    if not isinstance(backing, Lights | Touch):
        raise Unsupported(
            f"the emulator of the digital points of a UR controller cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind lights or touch as the emulator's backing device",
        )
    emulator = UrIoEmulator(backing, validate(options, UrIoEmulatorOptions, source="emulators.ur_io"))
    emulator.begin()
    return emulator
