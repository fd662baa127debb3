"""Emulated Dynamixel servo on a pty that moves any gripper: control table, current limit, watchdog."""

from __future__ import annotations

import struct
import time
from typing import Any

from drivers.dynamixel import protocol
from drivers.emulators.base import WireEmulator
from drivers.emulators.dynamixel import GOAL, INSTRUCTION, STATE, TICK, TORQUE, Servo
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer, PtyPort
from hal.devices import Device, Gripper
from hal.errors import Unsupported
from hal.strict import validate

ID = 7
CLOSED_COUNT, OPEN_COUNT = 2048, 3072
GOAL_CURRENT, PROFILE_VELOCITY = 102, 112
A_PER_COUNT, NEWTONS_PER_AMPERE = 0.00269, 60.0
MOVING_VELOCITY = 50
SLOWEST_M_PER_S = 0.01
TICKS = 32_768


class DynamixelGripperEmulator(WireEmulator):
    """Running emulator of the servo."""

    def __init__(self, backing: Gripper, options: FaultOptions) -> None:
        super().__init__(PtyPort("dynamixel-gripper"), options, name="dynamixel_gripper")
        self._backing = backing
        self._framer = protocol.framer()
        self.servo = Servo(ID)

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: port and stroke of the backing gripper."""
        return {**super().address, "stroke_m": self._backing.capabilities().max_width_m}

    def on_bytes(self, peer: Peer, data: bytes) -> None:  # noqa: ARG002  # a line has one peer
        """Carry out the instructions addressed to the servo."""
        for frame in self._framer.feed(data):
            packet = protocol.decode(frame)
            if packet.id == ID and packet.instruction != protocol.STATUS:
                error, answer = self._obey(packet)
                self._answer(error, answer)

    def status_frame(self) -> bytes | None:
        """Return an instruction error."""
        return protocol.encode(ID, protocol.STATUS, bytes([INSTRUCTION]))

    def _answer(self, error: int, data: bytes) -> None:
        status = bytes([error | self.servo.alert])
        self.send(None, protocol.encode(ID, protocol.STATUS, status + data), protected=slice(4, None))

    def _obey(self, packet: protocol.Packet) -> tuple[int, bytes]:
        p = packet.parameters
        if packet.instruction == protocol.PING:
            return 0, bytes(self.servo.table[0:2]) + bytes([self.servo.table[6]])
        if packet.instruction == protocol.READ:
            address, length = struct.unpack("<HH", p)
            self._refresh()
            return 0, bytes(self.servo.table[address : address + length])
        if packet.instruction == protocol.WRITE:
            address = int.from_bytes(p[:2], "little")
            error = self.servo.write(address, p[2:])
            if address == GOAL and not error and self.servo.table[TORQUE]:
                self._move()
            return error, b""
        return INSTRUCTION, b""

    def _move(self) -> None:
        c, table = self._backing.capabilities(), self.servo.table
        part = (self.servo.goal - CLOSED_COUNT) / (OPEN_COUNT - CLOSED_COUNT)
        current = int.from_bytes(table[GOAL_CURRENT : GOAL_CURRENT + 2], "little", signed=True)
        velocity = int.from_bytes(table[PROFILE_VELOCITY : PROFILE_VELOCITY + 4], "little")
        speed_m_per_s = velocity * 0.229 / 60.0 * 4096 * c.max_width_m / (OPEN_COUNT - CLOSED_COUNT)
        self._backing.command(
            width_m=min(max(part, 0.0), 1.0) * c.max_width_m,
            force_n=min(current * A_PER_COUNT * NEWTONS_PER_AMPERE, c.max_force_n),
            speed_m_per_s=min(max(speed_m_per_s, SLOWEST_M_PER_S), c.max_speed_m_per_s),
            deadline=self.deadline(),
        )

    def _refresh(self) -> None:
        """Copy current, velocity and position of the backing gripper into the control table."""
        c, held = self._backing.capabilities(), self._backing.read_state(deadline=self.deadline()).value
        position = round(CLOSED_COUNT + held.width_m / c.max_width_m * (OPEN_COUNT - CLOSED_COUNT))
        current = -int.from_bytes(self.servo.table[GOAL_CURRENT : GOAL_CURRENT + 2], "little") if held.is_holding else 0
        block = struct.pack("<hii", current, MOVING_VELOCITY if held.is_moving else 0, position)
        self.servo.table[STATE : STATE + len(block)] = block
        tick = int(time.monotonic() * 1000.0) % TICKS
        self.servo.table[TICK : TICK + 2] = tick.to_bytes(2, "little")


def start(backing: Device, options: dict[str, Any]) -> DynamixelGripperEmulator:
    """Start the emulator on a gripper (entry point `dynamixel_gripper`)."""
    if not isinstance(backing, Gripper):
        raise Unsupported(
            f"the emulator of a Dynamixel gripper cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind gripper as the emulator's backing device",
        )
    parsed = validate(options, FaultOptions, source="emulators.dynamixel_gripper")
    emulator = DynamixelGripperEmulator(backing, parsed)
    emulator.begin()
    return emulator
