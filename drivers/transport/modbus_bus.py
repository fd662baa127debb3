"""Creates Modbus buses from options: RTU if `port` is a path, TCP if it is a number; one shared bus per link."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from drivers.transport.bus import Bus
from drivers.transport.link import Link
from drivers.transport.modbus import RTU_GAP_S, ModbusMaster, ModbusRtu, ModbusTcp
from drivers.transport.options import EitherOptions, PortNumber, Seconds, SerialPath, either_opener
from hal.registry import Context
from hal.wires import ResourceClaim


class ModbusOptions(EitherOptions):
    """Keys of every Modbus device: `host` for TCP, or a path as `port` for RTU."""

    port: SerialPath | PortNumber = 502
    shared_as: ClassVar[str | None] = None

    unit: Annotated[int, Field(ge=1, le=247, description="address of the device on the bus (unit, slave id)")] = 1
    rate_hz: Annotated[float, Field(gt=0, le=500, description="polls per second")] = 100.0
    timeout_s: Annotated[Seconds, Field(description="wait for one answer")] = 0.1
    gap_s: Annotated[float, Field(ge=0, le=0.1, description="silence between two frames of RTU")] = RTU_GAP_S
    max_age_s: Annotated[Seconds, Field(description="an older sample is not returned")] = 0.1

    @model_validator(mode="after")
    def _is_somewhere(self) -> Self:
        if self.host is None and "port" not in self.model_fields_set:
            raise ValueError("say where the device is: host for Modbus TCP, or the path of a serial port as port")
        return self

    def claim(self) -> ResourceClaim:
        """Claim the unit on a shared bus."""
        bus = "Modbus TCP" if self.transport == "tcp" else f"Modbus RTU at {self.baud} baud"
        return ResourceClaim(wire=self.wire, bus=bus, stations=(f"unit {self.unit}",), shared_as=self.shared_as)


def modbus_bus(context: Context, options: ModbusOptions) -> Bus[ModbusMaster]:
    """Return the bus for these options; devices that name the same link share one bus."""
    opener, name = either_opener(options, context.name)

    def client(link: Link) -> ModbusMaster:
        if options.transport == "tcp":
            return ModbusTcp(link, timeout_s=options.timeout_s)
        return ModbusRtu(link, timeout_s=options.timeout_s, gap_s=options.gap_s)

    def make() -> Bus[ModbusMaster]:
        return Bus(name, open_link=opener, client=client)

    return context.shared.get(f"modbus {name}", make)
