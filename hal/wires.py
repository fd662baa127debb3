"""What devices take of the wires they hang on, read from their options before anything is opened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.errors import ConfigError
from hal.registry import device_factory, options_model
from hal.strict import Strict, validate


@dataclass(frozen=True, slots=True, kw_only=True)
class ResourceClaim:
    """What a device takes of a wire.

    Attributes:
        wire: the wire in words: `serial /dev/ttyUSB0`, `tcp 10.0.0.5:502`, `CAN can0`.
        bus: protocol and rate of a wire that several devices may share; None when it is this device's alone.
        stations: the addresses on the bus that are this device's: `unit 9`, `node 3`.
        shared_as: devices of the same word here may be on one station, as the functions of an I/O box are.
    """

    wire: str
    bus: str | None = None
    stations: tuple[str, ...] = ()
    shared_as: str | None = None

    @property
    def same_wire(self) -> str:
        """Equal for names of the same wire: a serial port has its own and stable ones that link to it."""
        sort, _, place = self.wire.partition(" ")
        return f"{sort} {Path(place).resolve()}" if place.startswith("/") else self.wire.lower()


class WireOptions(Strict):
    """Base of the options of devices on wires."""

    def claims(self) -> tuple[ResourceClaim, ...]:
        """What a device with these options takes; nothing, unless a model says more."""
        return ()


def claims_of(driver: str, options: dict[str, Any]) -> tuple[ResourceClaim, ...]:
    """What a device of `driver` takes of wires.

    Nothing for a driver whose entry point does not name its options (`hal.registry.takes`). Nothing either for one that
    is not installed and for options that it refuses: connecting says what is wrong with them.
    """
    try:
        model = options_model(device_factory(driver))
        if model is None or not issubclass(model, WireOptions):
            return ()
        return validate(options, model, source="options").claims()
    except ConfigError:
        return ()


def clash(one: ResourceClaim, other: ResourceClaim, *, apart: bool = False) -> tuple[str, str] | None:
    """Why two devices cannot both have what they claim, and the remedy; None when they can.

    Args:
        apart: they live in two processes, and a serial port is opened for one.
    """
    if one.same_wire != other.same_wire:
        return None
    if one.bus is None or other.bus is None:
        return f"both want {one.wire}", "it serves one device: give one of them another"
    if apart and one.wire.startswith("serial "):
        return f"share {one.wire}, but one of them is isolated", "devices of one serial bus live in one process"
    if one.bus != other.bus:
        what = f"share {one.wire}, but one speaks {one.bus} and the other {other.bus}"
        return what, "one wire carries one protocol at one rate: correct the rate, or the port of one of them"
    both = [station for station in one.stations if station in other.stations]
    if not both or (one.shared_as is not None and one.shared_as == other.shared_as):
        return None
    return f"both are {both[0]} on {one.wire} ({one.bus})", "each needs an address of its own on a bus they share"
