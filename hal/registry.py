"""Finds drivers by name among the entry points and loads them when a cell file needs them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, get_args, get_type_hints, runtime_checkable

from hal.clock import Clock, WallClock
from hal.config import Cell
from hal.devices import PROTOCOLS, ArmCapabilities, Device, DeviceKind
from hal.emulation import EmulatorFactory
from hal.entry_points import load, registered
from hal.errors import ConfigError
from hal.strict import Strict

DEVICES = "panelwright.devices"
EMULATORS = "panelwright.emulators"
OPTIONS = "options_model"
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])


@dataclass(slots=True, kw_only=True, eq=False)
class Shared:
    """Resources that several devices of a cell share (a world, a bus); each is made once and closed last."""

    _resources: dict[str, Any] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)

    def get(self, key: str, make: Callable[[], R]) -> R:
        """Return the resource under `key`; the first call makes it."""
        with self._lock:
            if key not in self._resources:
                self._resources[key] = make()
            resource: R = self._resources[key]
            return resource

    def peek(self, key: str) -> Any | None:
        """Return the resource under `key`, or None."""
        return self._resources.get(key)

    def why_ended(self) -> str | None:
        """Return why a resource has ended for good, such as the process of a world; None while all of them live."""
        for resource in list(self._resources.values()):
            look: Callable[[], str | None] | None = getattr(resource, "why_ended", None)
            if look is not None and (why := look()) is not None:
                return why
        return None

    def close(self) -> None:
        """Close everything in reverse order; a second call does nothing."""
        with self._lock:
            resources = list(self._resources.values())
            self._resources.clear()
        with ExitStack() as stack:  # calls in reverse order, also after errors
            for resource in resources:
                stack.callback(resource.close)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Context:
    """The parameters that a driver's factory gets in addition to its options.

    `cell` is None when a driver is used on its own. A simulated driver replaces the time with its world's:
    it registers `advance` at the `SimClock` in `clock`.
    """

    name: str
    clock: Clock = field(default_factory=WallClock)
    cell: Cell | None = None
    shared: Shared = field(default_factory=Shared)


Factory = Callable[[Context, dict[str, Any]], Device]
"""A driver's entry point: `connect(context, options) -> Device`; validates `options` with a strict model
(`ConfigError`), raises `DeviceUnavailable` when the device cannot be reached."""


def takes(model: type[Strict]) -> Callable[[F], F]:
    """Mark a driver's entry point with the model of its options, so that they can be checked without connecting."""

    def mark(factory: F) -> F:
        setattr(factory, OPTIONS, model)
        return factory

    return mark


def options_model(factory: Factory) -> type[Strict] | None:
    """Return the options model of a marked entry point; None without a mark."""
    return getattr(factory, OPTIONS, None)


@runtime_checkable
class KnowsItsArm(Protocol):
    """Options of an arm's driver that tell the arm's kinematics before anything is connected."""

    def known_arm(self) -> ArmCapabilities:
        """Return the kinematics and limits of the arm with these options."""
        ...


def kinds_of(factory: Factory) -> tuple[DeviceKind, ...] | None:
    """Return the device kinds whose interface the factory's declared return type has; None without a declaration."""
    try:
        declared = get_type_hints(factory).get("return")
    except (NameError, TypeError):
        return None
    classes = [each for each in (get_args(declared) or (declared,)) if isinstance(each, type)]
    kinds = [
        kind
        for kind, protocol in PROTOCOLS.items()
        if classes and all(set(_methods(protocol)) <= set(dir(each)) for each in classes)
    ]
    return tuple(kinds) or None


def _methods(protocol: type) -> list[str]:
    return [name for name, member in vars(protocol).items() if callable(member) and not name.startswith("_")]


def device_factory(driver: str) -> Factory:
    """Return the factory registered under `driver`, for example `serial:tfmini`.

    Raises:
        ConfigError: unknown name (with the nearest known one), or its package does not import.
    """
    factory: Factory = load(DEVICES, driver, "driver")
    return factory


def emulator_factory(name: str) -> EmulatorFactory:
    """Return the emulator factory registered under `name`.

    Raises:
        ConfigError: as `device_factory`.
    """
    factory: EmulatorFactory = load(EMULATORS, name, "emulator")
    return factory


def installed_drivers() -> tuple[str, ...]:
    """Return the names of all registered drivers."""
    return registered(DEVICES)


def _in_file(details: dict[str, Any], cell: Cell | None) -> dict[str, Any]:
    """Return a fault's details with the cell file and the full key, because driver options know only their table."""
    if cell is None or "key" not in details or "file" not in details:
        return details
    key = f"{details['file']}.{details['key']}".rstrip(".")  # empty key: the options contradict each other
    return {**details, "file": str(cell.path), "key": key}


def connect(context: Context, driver: str, options: dict[str, Any], *, key: str = "") -> Device:
    """Connect one device; a fault names the device and the key in the cell file."""
    try:
        return device_factory(driver)(context, options)
    except ConfigError as error:
        place = key or f"devices.{context.name}"
        file = f"{context.cell.path}: " if context.cell is not None else ""
        if str(error).startswith(place):  # it names its key, but not the file that the key is in
            raise ConfigError(
                f"{file}{error.what}", hint=error.hint, **_in_file(error.details, context.cell)
            ) from error
        raise ConfigError(f"{file}{place}: {error.what}", hint=error.hint, **error.details) from error
