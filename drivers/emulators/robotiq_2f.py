"""Emulated Robotiq 2F gripper on a pty, backed by any gripper."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field

from drivers.emulators.faults import FaultOptions
from drivers.emulators.modbus_server import ModbusFarSide, RegistersOnly, no_such
from drivers.emulators.ports import PtyPort
from hal.clock import Deadline, WallClock
from hal.devices import Device, Gripper
from hal.errors import Unsupported
from hal.strict import validate

OUTPUT, INPUT = 1000, 2000
OPEN_COUNT, CLOSED_COUNT = 3, 230
BACKING_S = 0.2
MIN_FORCE_N = 20.0
MIN_SPEED_M_PER_S = 0.02


class Robotiq2FEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    unit: Annotated[int, Field(ge=1, le=247)] = 9
    activation_s: Annotated[float, Field(ge=0, le=10)] = 0.1
    fault_code: Annotated[int, Field(ge=0, le=15)] = 0


def min_force_n(backing: Gripper) -> float:
    """Return the force of count 0 in newtons, which is the smallest with which this gripper family closes."""
    return min(MIN_FORCE_N, backing.capabilities().max_force_n)


class Robotiq2FTable(RegistersOnly):
    """Register map: output registers 1000-1002, input registers 2000-2002."""

    def __init__(self, backing: Gripper, activation_s: float) -> None:
        self.backing = backing
        self._activation_s = activation_s
        self._clock = WallClock()
        self._activated_at_s: float | None = None
        self.output = [0, 0, 0]
        self.fault = 0

    def registers(self, address: int, count: int) -> Sequence[int]:
        """Return status registers, or output registers as they were written."""
        for base, words in ((OUTPUT, self.output), (INPUT, self._status())):
            if base <= address and address + count <= base + 3:
                return words[address - base :][:count]
        raise no_such(address, count)

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Activate the gripper or move it to a position."""
        if address < OUTPUT or address + len(values) > OUTPUT + 3:
            raise no_such(address, *values)
        self.output[address - OUTPUT : address - OUTPUT + len(values)] = values
        action = self.output[0] >> 8
        if not action & 1:
            self._activated_at_s = None
        elif self._activated_at_s is None:
            self._activated_at_s = time.monotonic() + self._activation_s
        if action & 8 and self._is_ready():
            self._move()

    def _is_ready(self) -> bool:
        return self._activated_at_s is not None and time.monotonic() >= self._activated_at_s

    def _move(self) -> None:
        c = self.backing.capabilities()
        part = (CLOSED_COUNT - self.output[1] % 256) / (CLOSED_COUNT - OPEN_COUNT)
        width_m = c.min_width_m + min(max(part, 0.0), 1.0) * (c.max_width_m - c.min_width_m)
        speed, force = divmod(self.output[2], 256)
        self.backing.command(
            width_m=width_m,
            force_n=min_force_n(self.backing) + force / 255 * (c.max_force_n - min_force_n(self.backing)),
            speed_m_per_s=MIN_SPEED_M_PER_S + speed / 255 * (c.max_speed_m_per_s - MIN_SPEED_M_PER_S),
            deadline=Deadline.after(self._clock, BACKING_S),
        )

    def _status(self) -> list[int]:
        action = self.output[0] >> 8
        state = 0 if self._activated_at_s is None else 3 if self._is_ready() else 1
        held = self.backing.read_state(deadline=Deadline.after(self._clock, BACKING_S)).value
        c = self.backing.capabilities()
        part = (held.width_m - c.min_width_m) / (c.max_width_m - c.min_width_m)
        position = round(CLOSED_COUNT + min(max(part, 0.0), 1.0) * (OPEN_COUNT - CLOSED_COUNT))
        grip = 0 if held.is_moving else 2 if held.is_holding else 3
        first = (action & 9) | state << 4 | grip << 6
        return [first << 8, self.fault << 8 | self.output[1] % 256, position << 8 | (10 if held.is_moving else 0)]


class Robotiq2FEmulator(ModbusFarSide):
    """Running emulator of the gripper."""

    def __init__(self, backing: Gripper, options: Robotiq2FEmulatorOptions) -> None:
        self.table = Robotiq2FTable(backing, options.activation_s)
        self.table.fault = options.fault_code
        super().__init__(PtyPort("robotiq-2f"), options, self.table, unit=options.unit, name="robotiq_2f")

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: port, and stroke, speed and force limits of the backing gripper."""
        c = self.table.backing.capabilities()
        forces = {"min_force_n": min_force_n(self.table.backing), "max_force_n": c.max_force_n}
        return {**super().address, "stroke_m": c.max_width_m, "max_speed_m_per_s": c.max_speed_m_per_s, **forces}


def start(backing: Device, options: dict[str, Any]) -> Robotiq2FEmulator:
    """Start the emulator on a gripper (entry point `robotiq_2f`)."""
    if not isinstance(backing, Gripper):
        raise Unsupported(
            f"the emulator of a Robotiq 2F gripper cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind gripper as the emulator's backing device",
        )
    emulator = Robotiq2FEmulator(backing, validate(options, Robotiq2FEmulatorOptions, source="emulators.robotiq_2f"))
    emulator.begin()
    return emulator
