"""Modbus devices and their buses: RTU if `port` is a path, TCP if it is a number; one shared bus per link."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, Self, TypeVar

from pydantic import Field, model_validator

from drivers.transport.bus import Bus, PolledDevice
from drivers.transport.link import Link, now_s
from drivers.transport.modbus import RTU_GAP_S, ModbusMaster, ModbusRtu, ModbusTcp
from drivers.transport.options import EitherOptions, PortNumber, Seconds, SerialPath, either_opener
from hal.errors import DeviceFault
from hal.registry import Context
from hal.wires import ResourceClaim

T = TypeVar("T")


class ModbusOptions(EitherOptions):
    """Keys of every Modbus device: `host` for TCP, or a path as `port` for RTU."""

    port: SerialPath | PortNumber = 502
    shared_as: ClassVar[str | None] = None

    unit: Annotated[int, Field(ge=1, le=247, description="address of the device on the bus (unit, slave id)")] = 1
    rate_hz: Annotated[float, Field(gt=0, le=500, description="polls per second")] = 100.0
    timeout_s: Annotated[Seconds, Field(description="wait for one answer")] = 0.1
    gap_s: Annotated[float, Field(ge=0, le=0.1, description="silence between two frames of RTU")] = RTU_GAP_S
    max_age_s: Annotated[Seconds, Field(description="an older sample is not returned")] = 0.1
    product: Annotated[
        str | None,
        Field(
            min_length=1,
            description="part of the vendor, product or revision that the device must report by function 43/14; "
            "another device on the port, or one that reports none, is refused",
        ),
    ] = None

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


class ModbusDevice(PolledDevice[T, ModbusMaster]):
    """Device on a Modbus bus; the subclass defines how it is prepared and read."""

    def __init__(self, context: Context, options: ModbusOptions) -> None:
        bus = modbus_bus(context, options)
        super().__init__(context, bus, rate_hz=options.rate_hz, max_age_s=options.max_age_s)
        self._unit = options.unit
        self._product = options.product
        self._has_asked = False

    def set_up(self, client: ModbusMaster) -> None:
        """Compare what the device says of itself with the option `product`, if that is given, and prepare it."""
        if self._product is not None:
            self._identify(client)
            self._require(self._product)
        self.prepare(client)

    def poll(self, client: ModbusMaster) -> None:
        """Take a reading; after the first one ask who the device is, for people who look at its health."""
        self.take_reading(client)
        if not self._has_asked:
            self._identify(client)

    def prepare(self, client: ModbusMaster) -> None:
        """Check and configure the device; called again after each loss of the bus. By default nothing is to be done."""

    @abstractmethod
    def take_reading(self, client: ModbusMaster) -> None:
        """Request the newest values and publish them."""

    def _identify(self, client: ModbusMaster) -> None:
        self._has_asked = True
        self.identified = str(client.identity(self._unit, now_s() + client.attempt_s) or "")

    def _require(self, product: str) -> None:
        if product in self.identified:
            return
        says = f"says that it is {self.identified!r}" if self.identified else "does not say what it is (function 43/14)"
        raise DeviceFault(
            f"{self.name}: unit {self._unit} {says}, not {product!r}",
            hint="check port and unit number, or correct the option `product`",
            device=self.name,
            link=self.link_name(),
        )
