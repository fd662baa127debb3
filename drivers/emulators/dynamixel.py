"""Emulated Dynamixel servos on a pty, moving any arm: control tables, sync reads and writes, watchdog, shutdown."""

from __future__ import annotations

import math
import struct
import time
from typing import Any

import numpy as np

from drivers.dynamixel import protocol
from drivers.emulators.base import WireEmulator, time_of
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from drivers.kinds.arms import kinematics_of
from drivers.transport.checks import crc_dynamixel
from hal.devices import Arm, Device
from hal.errors import CellError, Unsupported
from hal.strict import validate

TABLE_BYTES = 147
EEPROM_BYTES = 64
TORQUE, STATUS_RETURN, HARDWARE_ERROR, WATCHDOG, GOAL, STATE, TICK = 64, 68, 70, 98, 116, 126, 120
ALWAYS = 2
RAD_PER_COUNT = math.tau / 4096
VELOCITY_UNIT = 0.229 * math.tau / 60.0
ACCESS, RANGE, INSTRUCTION = 7, 4, 2
OVERLOAD = 0x20


class Servo:
    """Control table of one servo."""

    def __init__(self, id_: int) -> None:
        self.table = bytearray(TABLE_BYTES)
        self.table[0:2] = (1020).to_bytes(2, "little")
        self.table[6], self.table[7], self.table[11], self.table[68] = 45, id_, 3, 2
        self.heard_s = -math.inf  # time of the last packet, on the backing arm's clock

    def write(self, address: int, data: bytes) -> int:
        """Write to the table and return the error number; 0 means done."""
        if address + len(data) > TABLE_BYTES:
            return RANGE
        if address < EEPROM_BYTES and self.table[TORQUE]:
            return ACCESS
        if address == GOAL and self.table[WATCHDOG] == 0xFF:
            return RANGE
        self.table[address : address + len(data)] = data
        return 0

    @property
    def goal(self) -> int:
        """Return the goal position in counts."""
        return int.from_bytes(self.table[GOAL : GOAL + 4], "little", signed=True)

    @property
    def alert(self) -> int:
        """Return the alert bit while a hardware error is present, else 0."""
        return protocol.ALERT if self.table[HARDWARE_ERROR] else 0


class DynamixelEmulator(WireEmulator):
    """Running emulator of one servo per joint of the backing arm."""

    def __init__(self, backing: Arm, options: FaultOptions) -> None:
        super().__init__(PtyPort("dynamixel"), options, name="dynamixel")
        self._backing = backing
        self.servos = {i + 1: Servo(i + 1) for i in range(len(backing.capabilities().links))}
        self._framer = protocol.framer()
        self.knows_fast_reads = True
        self._is_enabled = False
        self._is_new_goal = False
        self._device_s = 0.0
        self.period_s = 0.01

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: port, servo identifiers and kinematics."""
        return {**super().address, "ids": list(self.servos), "kinematics": kinematics_of(self._backing.capabilities())}

    def overload(self, id_: int) -> None:
        """Shut one servo down with an overload error."""
        self.servos[id_].table[HARDWARE_ERROR] = OVERLOAD
        self.servos[id_].table[TORQUE] = 0
        self._settle()

    def on_bytes(self, peer: Peer, data: bytes) -> None:  # noqa: ARG002  # a line has one peer
        """Carry out the instructions; every packet restarts the watchdogs."""
        for frame in self._framer.feed(data):
            packet = protocol.decode(frame)
            if packet.instruction == protocol.STATUS:
                continue
            for servo in self.servos.values():
                servo.heard_s = self._device_s
            self._obey(packet)
        self._settle()

    def on_tick(self) -> None:
        """Trip the watchdog of every servo whose time without a packet has run out."""
        self._device_s = time_of(self._backing.read_state(deadline=self.deadline()))
        for servo in self.servos.values():
            limit = servo.table[WATCHDOG]
            if 0 < limit < 0xFF and self._device_s - servo.heard_s > limit * 0.02:
                servo.table[WATCHDOG] = 0xFF
        self._settle()

    def status_frame(self) -> bytes | None:
        """Return an instruction error from the first servo."""
        return protocol.encode(next(iter(self.servos)), protocol.STATUS, bytes([INSTRUCTION]))

    def _obey(self, packet: protocol.Packet) -> None:
        p = packet.parameters
        if packet.instruction in (protocol.READ, protocol.SYNC_READ, protocol.FAST_SYNC_READ):
            self._refresh()  # once: all servos of an answer show one moment
        match packet.instruction:
            case protocol.PING:
                for id_ in self._addressed(packet.id):
                    self._answer(id_, 0, bytes(self.servos[id_].table[0:2]) + bytes([self.servos[id_].table[6]]))
            case protocol.READ if packet.id in self.servos:
                address, length = struct.unpack("<HH", p)
                self._answer(packet.id, 0, self._block(packet.id, address, length))
            case protocol.WRITE if packet.id in self.servos:
                error = self.servos[packet.id].write(int.from_bytes(p[:2], "little"), p[2:])
                self._is_new_goal |= p[:2] == GOAL.to_bytes(2, "little") and not error
                self._answer(packet.id, error)
            case protocol.SYNC_READ:
                address, length = struct.unpack_from("<HH", p)
                for id_ in p[4:]:
                    if id_ in self.servos:
                        self._answer(id_, 0, self._block(id_, address, length))
            case protocol.FAST_SYNC_READ if self.knows_fast_reads:
                self._fast_answer(p)
            case protocol.SYNC_WRITE:
                self._sync_write(p)
            case protocol.REBOOT if packet.id in self.servos:
                self.servos[packet.id] = Servo(packet.id)
                self._answer(packet.id, 0)
            case _ if packet.id in self.servos:
                self._answer(packet.id, INSTRUCTION)

    def _addressed(self, id_: int) -> list[int]:
        return list(self.servos) if id_ == protocol.BROADCAST else [id_] if id_ in self.servos else []

    def _answer(self, id_: int, error: int, data: bytes = b"") -> None:
        if not data and self.servos[id_].table[STATUS_RETURN] != ALWAYS:
            return
        error |= self.servos[id_].alert
        self.send(None, protocol.encode(id_, protocol.STATUS, bytes([error]) + data), protected=slice(4, None))

    def _fast_answer(self, parameters: bytes) -> None:
        """Answer a fast sync read: one packet for all servos, not byte-stuffed, with a running CRC after each block."""
        address, length = struct.unpack_from("<HH", parameters)
        ids = [id_ for id_ in parameters[4:] if id_ in self.servos]
        if len(ids) != len(parameters) - 4:
            return
        frame = (
            protocol.HEADER
            + bytes([protocol.BROADCAST])
            + struct.pack("<HB", 1 + len(ids) * (4 + length), protocol.STATUS)
        )
        for id_ in ids:
            frame += bytes([self.servos[id_].alert, id_]) + self._block(id_, address, length)
            frame += struct.pack("<H", crc_dynamixel(frame))
        self.send(None, frame, protected=slice(4, None))

    def _sync_write(self, parameters: bytes) -> None:
        address, length = struct.unpack_from("<HH", parameters)
        for at in range(4, len(parameters), 1 + length):
            servo = self.servos.get(parameters[at])
            if servo is not None:
                error = servo.write(address, parameters[at + 1 : at + 1 + length])
                self._is_new_goal |= address == GOAL and not error

    def _block(self, id_: int, address: int, length: int) -> bytes:
        return bytes(self.servos[id_].table[address : address + length])

    def _refresh(self) -> None:
        """Copy position and velocity from the backing arm into the control tables."""
        try:
            state = self._backing.read_state(deadline=self.deadline()).value
        except CellError:
            return
        tick = int(time.monotonic() * 1000) % 32_768
        for i, servo in enumerate(self.servos.values()):
            position = round(float(state.position_rad[i]) / RAD_PER_COUNT) + 2048
            velocity = round(float(state.velocity_rad_per_s[i]) / VELOCITY_UNIT)
            servo.table[STATE : STATE + 10] = struct.pack("<hii", 0, velocity, position)
            servo.table[TICK : TICK + 2] = tick.to_bytes(2, "little")

    def _settle(self) -> None:
        """Let the backing arm follow the goals while all servos have torque and no watchdog has tripped, or stop it."""
        is_on = all(s.table[TORQUE] and s.table[WATCHDOG] != 0xFF for s in self.servos.values())
        if is_on and not self._is_enabled:
            self._backing.enable(deadline=self.deadline())
        if self._is_enabled and not is_on:
            self._backing.stop(deadline=self.deadline())
        self._is_enabled = is_on
        if is_on and self._is_new_goal:
            goal = np.array([(servo.goal - 2048) * RAD_PER_COUNT for servo in self.servos.values()])
            self._backing.command_position(goal, deadline=self.deadline())
        self._is_new_goal = False


def start(backing: Device, options: dict[str, Any]) -> DynamixelEmulator:
    """Start the emulator on an arm (entry point `dynamixel`)."""
    if not isinstance(backing, Arm):
        raise Unsupported(
            f"the emulator of an arm of Dynamixel servos cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind arm as the emulator's backing device",
        )
    emulator = DynamixelEmulator(backing, validate(options, FaultOptions, source="emulators.dynamixel"))
    emulator.begin()
    return emulator
