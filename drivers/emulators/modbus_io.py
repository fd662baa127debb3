"""Emulated remote I/O with the register map of the Moxa ioLogik E1200; a lights, touch or proximity device backs it.

Wiring of the cell: DO0-3 lights; DI0-3 their feedback; DI4/5 touch left/right; DI6 proximity switch; DI7 stop circuit
(1 = healthy).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.emulators.faults import FaultOptions
from drivers.emulators.modbus_server import ILLEGAL_ADDRESS, ModbusException, ModbusFarSide
from drivers.emulators.ports import PtyPort, TcpPort
from hal.clock import Deadline, WallClock
from hal.devices import Device, Lights, Proximity, Touch
from hal.readings import Quality
from hal.strict import validate

POINTS = 8
DI_WORD, DO_WORD, COUNTERS = 0x30, 0x20, 0x10
BACKING_S = 0.2


class ModbusIoOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    transport: Literal["tcp", "rtu"] = "tcp"
    tcp_port: Annotated[int, Field(ge=0, le=65535)] = 0
    unit: Annotated[int, Field(ge=1, le=247)] = 1
    switching_distance_m: Annotated[float, Field(gt=0)] = 0.02


class IoTable:
    """Eight outputs and eight inputs, some of them connected to the backing device."""

    def __init__(self, backing: Device, switching_distance_m: float) -> None:
        # The kind is determined once, because an isinstance check against a protocol takes 30 us.
        self._lights = backing if isinstance(backing, Lights) else None
        self._touch = backing if isinstance(backing, Touch) else None
        self._proximity = backing if isinstance(backing, Proximity) else None
        self._switching_distance_m = switching_distance_m
        self._clock = WallClock()
        self.outputs = [False] * POINTS
        self.is_healthy = True
        self.counters = [0] * POINTS
        self._before = [False] * POINTS

    def inputs(self) -> list[bool]:
        """Return the present states of DI0 to DI7 and count their rising edges."""
        now = [False] * 7 + [self.is_healthy]
        deadline = Deadline.after(self._clock, BACKING_S)
        if self._lights is not None:
            lit = self._lights.read_on(deadline=deadline).value
            now[: len(lit)] = lit
        if self._touch is not None:
            contacts = self._touch.read_contacts(deadline=deadline).value
            now[4:6] = (*contacts, False, False)[:2]
        if self._proximity is not None:
            sample = self._proximity.read_distance_m(deadline=deadline)
            now[6] = sample.quality is not Quality.INVALID and sample.value <= self._switching_distance_m
        for i, (was, is_on) in enumerate(zip(self._before, now, strict=True)):
            self.counters[i] += is_on and not was
        self._before = now
        return now

    def read_bits(self, function: int, address: int, count: int) -> Sequence[bool]:
        """Return coils 0-7 or discrete inputs 0-7."""
        if address + count > POINTS or count < 1:
            raise ModbusException(ILLEGAL_ADDRESS)
        points = self.outputs if function == 1 else self.inputs()
        return points[address : address + count]

    def read_registers(self, function: int, address: int, count: int) -> Sequence[int]:
        """Return registers: input 30h DI word, input 10h and up counters (high word first), holding 20h DO word."""
        if (function, address, count) == (4, DI_WORD, 1):
            return [_word(self.inputs())]
        if (function, address, count) == (3, DO_WORD, 1):
            return [_word(self.outputs)]
        if function == 4 and address >= COUNTERS and address + count <= COUNTERS + 2 * POINTS:
            words = [half for c in self.counters for half in (c >> 16 & 0xFFFF, c & 0xFFFF)]
            return words[address - COUNTERS :][:count]
        raise ModbusException(ILLEGAL_ADDRESS)

    def write_bits(self, address: int, values: Sequence[bool]) -> None:
        """Write coils 0-7; the first four switch the lights."""
        if address + len(values) > POINTS:
            raise ModbusException(ILLEGAL_ADDRESS)
        self.outputs[address : address + len(values)] = values
        if self._lights is not None:
            count = len(self._lights.capabilities().channels)
            self._lights.set_on(self.outputs[:count], deadline=Deadline.after(self._clock, BACKING_S))

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Write holding register 20h, the word of all outputs."""
        if address != DO_WORD or len(values) != 1:
            raise ModbusException(ILLEGAL_ADDRESS)
        self.write_bits(0, [bool(values[0] >> i & 1) for i in range(POINTS)])


def _word(points: Sequence[bool]) -> int:
    return sum(1 << i for i, on in enumerate(points) if on)


class ModbusIoEmulator(ModbusFarSide):
    """Running emulator of the remote I/O; tests use `table` to set inputs and check outputs."""

    def __init__(self, backing: Device, options: ModbusIoOptions) -> None:
        self.table = IoTable(backing, options.switching_distance_m)
        port = PtyPort("modbus-io") if options.transport == "rtu" else TcpPort(options.tcp_port)
        super().__init__(port, options, self.table, unit=options.unit, name="modbus_io")


def start(backing: Device, options: dict[str, Any]) -> ModbusIoEmulator:
    """Start the emulator on any device (entry point `modbus_io`)."""
    emulator = ModbusIoEmulator(backing, validate(options, ModbusIoOptions, source="emulators.modbus_io"))
    emulator.begin()
    return emulator
