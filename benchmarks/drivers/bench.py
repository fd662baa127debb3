"""Test setup of one driver with its emulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from drivers.emulators.faults import WireFault


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Test setup of one device: emulator, driver, options, and a check that a value is one of the latest true ones."""

    name: str
    start: Callable[[Any, dict[str, Any]], Any]  # returns a `WireEmulator`, or what has its address and `close`
    backing: Callable[[], Any]
    driver: str
    is_true: Callable[[Any, Any], bool]
    options: dict[str, Any] = field(default_factory=dict)
    far_options: dict[str, Any] = field(default_factory=dict)
    faults: tuple[WireFault, ...] = tuple(WireFault)
    read: Callable[[Any, Any], Any] = lambda device, deadline: device.newest(deadline)
    """Reads the device until a deadline."""
    make: Callable[[Any, Any], Any] | None = None
    """Makes the driver from its context and the far side; by its entry point and the far side's address if not given."""
    is_plugged: bool = True
    """Whether the far side can be unplugged."""
    is_alone: bool = False
    """Whether only one such far side can run on a machine."""
    taken_s: Callable[[Any, Any], float] | None = None
    """Returns when a value was taken (monotonic clock); None if the value or the protocol does not reveal it."""
    stamps: Literal["log", "own log", "taken", "device"] | None = "log"
    """What time stamps are compared with: the log of sent frames of an emulator in another process or in the driver's,
    `taken_s`, the stamps of a device that has this machine's clock, or nothing."""


WITHOUT_CRC = tuple(f for f in WireFault if f is not WireFault.CRC)
WITHOUT_ECHO = tuple(f for f in WireFault if f is not WireFault.ECHO)  # of a two-wire line; a WebSocket server has none
