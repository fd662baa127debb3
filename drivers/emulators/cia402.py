"""Emulated CiA-402 drives behind an slcan adapter (pty, TCP) or on a virtual bus; they move an arm of any backend."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.cia402.states import DriveState
from drivers.emulators.base import WireEmulator, time_of
from drivers.emulators.can_port import CanLines, VirtualCanPort, can_address
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import FarPort, Peer, PtyPort, TcpPort
from drivers.kinds.arms import kinematics_of
from drivers.transport.can_frames import CanFrame
from hal.devices import Arm, Device
from hal.errors import CellError, Unsupported
from hal.strict import validate

RAD = math.radians(0.001)
STATUS = {
    DriveState.SWITCH_ON_DISABLED: 0x40,
    DriveState.READY: 0x21,
    DriveState.SWITCHED_ON: 0x23,
    DriveState.OPERATION_ENABLED: 0x27,
    DriveState.QUICK_STOP: 0x07,
    DriveState.FAULT: 0x08,
}
NO_OBJECT, READ_ONLY = 0x06020000, 0x06010002
HOST_LOST = 0x8130
SIZES = {1: 0x4F, 2: 0x4B, 3: 0x47, 4: 0x43}


PORTS: dict[str, Callable[[], FarPort]] = {
    "serial": lambda: PtyPort("slcan"),
    "tcp": TcpPort,
    "virtual": lambda: VirtualCanPort("cia402"),
}


class Cia402EmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    transport: Literal["serial", "tcp", "virtual"] = "serial"
    first_node: Annotated[int, Field(ge=1, le=100)] = 1


class Drive:
    """Object dictionary and state machine of one axis."""

    def __init__(self) -> None:
        self.state = DriveState.SWITCH_ON_DISABLED
        self.objects: dict[tuple[int, int], bytes] = {
            (0x1000, 0): struct.pack("<I", 0x20192),
            (0x1600, 1): struct.pack("<I", 0x60400010),
            (0x1600, 2): struct.pack("<I", 0x607A0020),
            (0x1A00, 1): struct.pack("<I", 0x60410010),
            (0x1A00, 2): struct.pack("<I", 0x60640020),
            (0x1016, 1): bytes(4),
            (0x1017, 0): bytes(2),
            (0x6060, 0): b"\x00",
            (0x6041, 0): struct.pack("<H", 0x40),
            (0x6064, 0): bytes(4),
            (0x603F, 0): bytes(2),
        }
        self.target = 0
        self.is_operational = False
        self._last_control = 0

    def control(self, word: int) -> None:
        """Apply one control word to the state machine (CiA 402-2, table 29)."""
        is_reset = bool(word & 0x80) and not self._last_control & 0x80
        self._last_control = word
        if self.state is DriveState.FAULT:
            self.state = DriveState.SWITCH_ON_DISABLED if is_reset else DriveState.FAULT
        elif not word & 0x02:
            self.state = DriveState.SWITCH_ON_DISABLED
        elif not word & 0x04:
            is_on = self.state is DriveState.OPERATION_ENABLED
            self.state = DriveState.QUICK_STOP if is_on else DriveState.SWITCH_ON_DISABLED
        else:
            self.state = self._advance(word & 0x0F)

    def _advance(self, word: int) -> DriveState:
        steps = {
            (DriveState.SWITCH_ON_DISABLED, 6): DriveState.READY,
            (DriveState.READY, 7): DriveState.SWITCHED_ON,
            (DriveState.SWITCHED_ON, 15): DriveState.OPERATION_ENABLED,
            (DriveState.OPERATION_ENABLED, 7): DriveState.SWITCHED_ON,
            (DriveState.OPERATION_ENABLED, 6): DriveState.READY,
            (DriveState.SWITCHED_ON, 6): DriveState.READY,
        }
        return steps.get((self.state, word), self.state)

    @property
    def status(self) -> int:
        """Return the status word, object 6041h."""
        return STATUS[self.state]


class Cia402Emulator(WireEmulator):
    """Running emulator of one drive per joint of the backing arm."""

    def __init__(self, backing: Arm, options: Cia402EmulatorOptions) -> None:
        super().__init__(PORTS[options.transport](), options, name="cia402")
        self._backing = backing
        self.nodes = tuple(range(options.first_node, options.first_node + len(backing.capabilities().links)))
        self.drives = {node: Drive() for node in self.nodes}
        self._lines = CanLines()
        self._device_s = 0.0
        self._host_s: float | None = None
        self._consumer_s = 0.0
        self._is_moving_allowed = False
        self.period_s = 0.01
        self.syncs = 0

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: channel, node numbers and kinematics."""
        kinematics = kinematics_of(self._backing.capabilities())
        return {**can_address(self.port), "nodes": list(self.nodes), "kinematics": kinematics}

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Acknowledge slcan commands and carry out CAN frames."""
        if b"O\r" in data:
            self.reply(peer, b"\r")
        for frame in self._lines.feed(data):
            self._frame(frame)

    def on_tick(self) -> None:
        """Check the host's heartbeat; all drives fault when it is overdue."""
        self._device_s = time_of(self._backing.read_state(deadline=self.deadline()))
        is_late = self._host_s is not None and self._device_s - self._host_s > self._consumer_s
        if is_late and self._consumer_s > 0.0:
            self._host_s = None
            self.fault(HOST_LOST)

    def fault(self, code: int) -> None:
        """Put all drives into the fault state, stop the arm, and send the error `code` in emergency messages."""
        for node, drive in self.drives.items():
            drive.state = DriveState.FAULT
            drive.objects[(0x603F, 0)] = struct.pack("<H", code)
            self._out(0x80 + node, struct.pack("<HB5x", code, 0x11))
        self._settle()

    def restart(self, node: int) -> None:
        """Restart one drive, as after a power cycle, and send its boot-up message."""
        self.drives[node] = Drive()
        self._settle()
        self._out(0x700 + node, b"\x00")

    def status_frame(self) -> bytes | None:
        """Return an emergency message that reports over-current in the first drive."""
        return self._lines.encode(CanFrame(0x80 + self.nodes[0], struct.pack("<HB5x", 0x2310, 0x02)))

    def _frame(self, frame: CanFrame) -> None:
        node, function = frame.id & 0x7F, frame.id & 0x780
        if frame.id == 0x000 and len(frame.data) == 2:
            self._network(*frame.data)
        elif frame.id == 0x080:
            self._on_sync()
        elif function == 0x700 and node not in self.drives:
            self._host_s = self._device_s
        elif function == 0x600 and node in self.drives and len(frame.data) == 8:
            self._out(0x580 + node, self._sdo(self.drives[node], frame.data))
        elif function == 0x200 and node in self.drives and len(frame.data) == 6:
            control, self.drives[node].target = struct.unpack("<Hi", frame.data)
            self.drives[node].control(control)

    def _network(self, command: int, node: int) -> None:
        for n in self.nodes if node == 0 else (node,):
            if n in self.drives:
                self.drives[n].is_operational = command == 1
            if command == 0x81:
                self.restart(n)

    def _sdo(self, drive: Drive, request: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", request)
        key = (index, sub)
        if key not in drive.objects:
            return struct.pack("<BHBI", 0x80, index, sub, NO_OBJECT)
        if command == 0x40:
            value = struct.pack("<H", drive.status) if index == 0x6041 else drive.objects[key]
            return struct.pack("<BHB", SIZES[len(value)], index, sub) + value.ljust(4, b"\0")
        if index in (0x1000, 0x6041, 0x6064):
            return struct.pack("<BHBI", 0x80, index, sub, READ_ONLY)
        drive.objects[key] = request[4 : 8 - (command >> 2 & 3)]
        if index == 0x1016:
            self._consumer_s = (int.from_bytes(drive.objects[key], "little") & 0xFFFF) / 1000.0
        return struct.pack("<BHB4x", 0x60, index, sub)

    def _on_sync(self) -> None:
        self.syncs += 1
        self._settle()
        if self._is_moving_allowed:
            goal = np.array([self.drives[n].target for n in self.nodes]) * RAD
            self._backing.command_position(goal, deadline=self.deadline())
        try:
            state = self._backing.read_state(deadline=self.deadline()).value
        except CellError:
            return
        for i, node in enumerate(self.nodes):
            drive = self.drives[node]
            if drive.is_operational:
                increments = round(float(state.position_rad[i]) / RAD)
                self._out(0x180 + node, struct.pack("<Hi", drive.status, increments))
                self._out(0x280 + node, struct.pack("<ih", round(float(state.velocity_rad_per_s[i]) / RAD), 0))

    def _settle(self) -> None:
        """Enable the backing arm when all drives are enabled, and stop it when one no longer is."""
        states = {drive.state for drive in self.drives.values()}
        is_allowed = states == {DriveState.OPERATION_ENABLED}
        if is_allowed and not self._is_moving_allowed:
            self._backing.enable(deadline=self.deadline())
        if self._is_moving_allowed and not is_allowed:
            self._backing.stop(deadline=self.deadline())
        self._is_moving_allowed = is_allowed

    def _out(self, id_: int, data: bytes) -> None:
        # A CAN bus checks its frames itself (CRC-15), so a damaged one never reaches the adapter.
        self.send(None, self._lines.encode(CanFrame(id_, data)), protected=slice(0, 0))


def start(backing: Device, options: dict[str, Any]) -> Cia402Emulator:
    """Start the emulator on an arm (entry point `cia402`)."""
    if not isinstance(backing, Arm):
        raise Unsupported(
            f"the emulator of an arm of CiA 402 drives cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind arm as the emulator's backing device",
        )
    emulator = Cia402Emulator(backing, validate(options, Cia402EmulatorOptions, source="emulators.cia402"))
    emulator.begin()
    return emulator
