"""Slots for the devices of a running cell; calls to a slot reach the device that is installed at that time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, NoReturn, Protocol

from hal.clock import Deadline
from hal.config import Cell, DeviceSection
from hal.devices import PROTOCOLS, DeviceKind, Health
from hal.errors import CellError, ConfigError, DeviceUnavailable, MotionRefused
from hal.readings import Cause, Quality
from service.errors import Busy, NotConnected

WIRE_KEYS = ("host", "port", "channel", "device")  # options that name a port which only one driver can use at a time
HAS_MEMORY = {DeviceKind.ARM, DeviceKind.FORCE_TORQUE}  # the control thread stores the kinematics and the bias of these
IN_MOTION = HAS_MEMORY | {DeviceKind.GRIPPER, DeviceKind.TOUCH, DeviceKind.PROXIMITY}
log = logging.getLogger(__name__)


class DeviceSlot:
    """Forwards every call to the installed device."""

    def __init__(self, device: Any) -> None:
        self._device = device

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._device, name)

    def __dir__(self) -> list[str]:
        return dir(self._device)  # a host serves these names to other processes

    def close(self) -> None:
        """Close the installed device."""
        self._device.close()

    def installed(self) -> Any:
        """Return the installed device."""
        return self._device

    def install(self, device: Any) -> None:
        """Install another device; the caller closes the previous one."""
        self._device = device


class UnavailableDevice:
    """Placeholder for a device that did not connect, so that the rest of the cell can be used.

    It has the interface of its kind; every call raises an error with the cause and how to connect again.

    Args:
        error: why connecting failed.
    """

    def __init__(self, name: str, kind: DeviceKind, error: CellError) -> None:
        self.name, self.kind = name, kind
        self._why = NotConnected(
            f"{name} did not connect: {error.what.removeprefix(name).lstrip(': ')}",
            hint=f"{error.hint}; then POST /v1/devices/{name}/connect",
            **{**error.details, "device": name},
        )

    def __dir__(self) -> list[str]:
        return ["name", *dir(PROTOCOLS[self.kind])]  # a host serves these names to other processes

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_") or attribute not in dir(PROTOCOLS[self.kind]):
            raise AttributeError(attribute)
        return self._refuse

    def _refuse(self, *_args: Any, **_kwargs: Any) -> NoReturn:
        raise self._why

    @property
    def why(self) -> NotConnected:
        """The error that every call raises."""
        return self._why

    def health(self) -> Health:
        """Return the state "not connected" with its cause."""
        return Health(connected=False, quality=Quality.INVALID, cause=Cause.COMM, detail=self._why.what)

    def close(self) -> None:
        """Do nothing, because no device is open."""


class MotionDesk(Protocol):
    """The methods of the motion port that a swap needs."""

    def at_rest(self, work: Callable[[], None]) -> None:
        """Run `work` while no motion runs and none can begin.

        Raises:
            MotionRefused: a motion runs.
        """
        ...

    def restart(self, between: Callable[[], None]) -> None:
        """End the control thread (this stops the arm), run `between`, and start a new thread with the drives off.

        Raises:
            MotionRefused: a motion runs.
        """
        ...


Connect = Callable[[str, DeviceSection], Any]
"""Connects a device by its name and its section; `Complete` has completed the section."""
Complete = Callable[[str, DeviceSection], DeviceSection]
"""Adds the emulator's address to a section whose device the cell emulates, unless the section names another wire."""


class Swapper:
    """Replaces devices in the slots while the cell runs, one at a time.

    The new device is connected before the old one is closed, unless both use the same port. Motion power is off after a
    swap of the arm until the next declared motion asks for it, and a device that moves is not swapped during a motion.

    Args:
        connect, complete: the functions that the start of the cell used.
        motion: the motion port; None in a cell without an arm.
    """

    def __init__(
        self,
        cell: Cell,
        *,
        connect: Connect,
        complete: Complete,
        slots: Mapping[str, DeviceSlot],
        motion: MotionDesk | None,
    ) -> None:
        self._sections = cell.file.devices
        self._connect = connect
        self._complete = complete
        self._slots = slots
        self._motion = motion
        self._busy = threading.Lock()

    def swap(self, name: str, driver: str, options: dict[str, Any], *, deadline: Deadline) -> None:  # noqa: ARG002 - an interface
        """Install another driver, or the same one with other options, for the device `name`.

        Args:
            deadline: when the caller stops waiting for the answer; a failing connection takes as long as its driver tries.

        Raises:
            DeviceError, ConfigError: the new device did not connect; the old one is kept, and the error says so.
            MotionRefused: a motion runs.
            Busy: another device is being swapped.
        """
        if not self._busy.acquire(blocking=False):
            raise Busy("another device is being swapped", hint="send it again in a moment", device=name)
        try:
            section = self._sections[name].model_copy(update={"driver": driver, "options": options})
            old, new = self._complete(name, self._sections[name]), self._complete(name, section)
            if isinstance(self._slots[name].installed(), UnavailableDevice):
                self._fill(name, new)
            elif _share_a_port(old, new):
                self._swap_on_one_port(name, old, new)
            else:
                self._swap_side_by_side(name, new)
            self._sections[name] = section  # readers of the cell's sections see the connected device
        finally:
            self._busy.release()

    def _fill(self, name: str, new: DeviceSection) -> None:
        """Install a device in a slot that holds an `UnavailableDevice`."""
        slot = self._slots[name]
        try:
            fresh = self._connect(name, new)
        except Exception as error:
            failure = failure_of(name, error)
            slot.install(UnavailableDevice(name, new.kind, failure))
            raise failure from error
        try:
            self._at_rest(new.kind, lambda: slot.install(fresh))
        except CellError as error:  # the control thread refuses the new device
            slot.install(UnavailableDevice(name, new.kind, error))
            fresh.close()
            raise

    def _swap_side_by_side(self, name: str, new: DeviceSection) -> None:
        slot, old = self._slots[name], self._slots[name].installed()
        with self._kept(name):
            fresh = self._connect(name, new)
        try:
            with self._kept(name):
                self._at_rest(new.kind, lambda: slot.install(fresh))
        except CellError:
            if slot.installed() is fresh:  # the control thread refuses the new device
                self._at_rest(new.kind, lambda: slot.install(old))
            fresh.close()
            raise
        old.close()

    def _swap_on_one_port(self, name: str, old: DeviceSection, new: DeviceSection) -> None:
        try:
            with self._kept(name):
                self._at_rest(new.kind, lambda: self._replace(name, new))
        except MotionRefused:
            raise  # the old device is still installed
        except CellError:
            self._at_rest(new.kind, lambda: self._return(name, old))
            raise

    def _replace(self, name: str, section: DeviceSection) -> None:
        slot = self._slots[name]
        slot.close()
        slot.install(self._connect(name, section))

    def _return(self, name: str, old: DeviceSection) -> None:
        """Connect the old device again after the new device on the same port did not connect."""
        try:
            self._replace(name, old)
        except CellError as error:
            raise DeviceUnavailable(
                f"{name}: the new driver did not connect, and the old one, {old.driver}, did not come back: {error.what}",
                hint=error.hint,
                device=name,
            ) from error

    def _at_rest(self, kind: DeviceKind, work: Callable[[], None]) -> None:
        if self._motion is None or kind not in IN_MOTION:
            work()
        elif kind in HAS_MEMORY:
            self._motion.restart(work)
        else:
            self._motion.at_rest(work)

    @contextmanager
    def _kept(self, name: str) -> Iterator[None]:
        """Add to errors raised inside that the old device is kept."""
        driver = self._sections[name].driver
        kept = f"{name} keeps {driver}, as the new driver"
        try:
            yield
        except MotionRefused:
            raise
        except CellError as error:
            details = {**error.details, "kept": driver}
            raise type(error)(f"{kept} did not connect: {error.what}", hint=error.hint, **details) from error
        except Exception as error:  # a defect of the new driver
            log.exception("devices.%s", name)
            raise DeviceUnavailable(
                f"{kept} failed: {type(error).__name__}: {error}",
                hint="report it to the driver's author",
                device=name,
                kept=driver,
            ) from error


def failure_of(name: str, error: BaseException) -> CellError:
    """Return the error of a failed connection; a defect of the driver is logged and returned as `DeviceUnavailable`."""
    if isinstance(error, CellError):
        return error
    log.error("devices.%s", name, exc_info=error)
    text = f"its driver failed: {type(error).__name__}: {error}"
    return DeviceUnavailable(text, hint="report it to the driver's author", device=name)


def checked(name: str, device: Any, section: DeviceSection) -> Any:
    """Return the device if it has the kind that its section names.

    Raises:
        ConfigError: it has another kind; it has been closed.
    """
    if device.kind is section.kind:
        return device
    with suppress(CellError):
        device.close()
    raise ConfigError(
        f"devices.{name}.driver: {section.driver} is a {device.kind}, not a {section.kind}",
        hint=f"choose a driver of a {section.kind}",
        key=f"devices.{name}.driver",
    )


def names_another_wire(section: DeviceSection, own: DeviceSection) -> bool:
    """Return whether the options name a wire that differs from the one in the cell file."""
    keys = (*WIRE_KEYS, "replay")
    return any(key in section.options and section.options[key] != own.options.get(key) for key in keys)


def _share_a_port(a: DeviceSection, b: DeviceSection) -> bool:
    wires = [tuple(section.options.get(key) for key in WIRE_KEYS) for section in (a, b)]
    return wires[0] == wires[1] and any(part is not None for part in wires[0])
