"""Determines from the options which wires and bus addresses devices use, before anything is opened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.errors import ConfigError
from hal.registry import device_factory, options_model
from hal.strict import Strict, validate


@dataclass(frozen=True, slots=True, kw_only=True)
class ResourceClaim:
    """The use of a wire by a device.

    Attributes:
        wire: the wire in words: `serial /dev/ttyUSB0`, `tcp 10.0.0.5:502`, `CAN can0`.
        bus: protocol and rate of a wire that several devices may share; None when it is this device's alone.
        stations: the bus addresses of this device, such as `unit 9` or `node 3`.
        shared_as: devices with the same word here may use one station, such as the functions of an I/O box.
    """

    wire: str
    bus: str | None = None
    stations: tuple[str, ...] = ()
    shared_as: str | None = None

    @property
    def same_wire(self) -> str:
        """Return a key that is equal for all names of the same wire, because a serial port may also have linked names."""
        sort, _, place = self.wire.partition(" ")
        return f"{sort} {Path(place).resolve()}" if place.startswith("/") else self.wire.lower()


class WireOptions(Strict):
    """Base of the options of devices on wires."""

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Return the wires that a device with these options uses; none unless a subclass overrides this."""
        return ()


def claims_of(driver: str, options: dict[str, Any]) -> tuple[ResourceClaim, ...]:
    """Return the wires that a device of `driver` uses.

    Empty for a driver whose entry point does not name its options (`hal.registry.takes`), for a driver that
    is not installed, and for options that it refuses: connecting reports what is wrong with them.
    """
    try:
        model = options_model(device_factory(driver))
        if model is None or not issubclass(model, WireOptions):
            return ()
        return validate(options, model, source="options").claims()
    except ConfigError:
        return ()


def clash(one: ResourceClaim, other: ResourceClaim, *, apart: bool = False) -> tuple[str, str] | None:
    """Return why two devices cannot both use what they claim, and the remedy; None when they can.

    Args:
        apart: whether they are in two processes; a serial port can be opened by only one.
    """
    if one.same_wire != other.same_wire:
        return None
    if one.bus is None or other.bus is None:
        return f"both use {one.wire}", "it can serve only one device: give one of the two another port or path"
    if apart and one.wire.startswith("serial "):
        return (
            f"share {one.wire}, but one of them is isolated",
            "devices on the same serial bus must run in the same process: remove isolate = true",
        )
    if one.bus != other.bus:
        what = f"share {one.wire}, but one speaks {one.bus} and the other {other.bus}"
        return what, "one wire carries one protocol at one rate: correct the rate, or the port of one of them"
    both = [station for station in one.stations if station in other.stations]
    if not both or (one.shared_as is not None and one.shared_as == other.shared_as):
        return None
    return f"both are {both[0]} on {one.wire} ({one.bus})", "give each device on a shared bus its own address"
