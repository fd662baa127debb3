"""The service's access to a cell (devices, mover and clock), the same inline and across processes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, Protocol, cast

from hal.clock import Clock, Deadline, WallClock
from hal.config import Cell, DeviceSection
from hal.devices import DeviceKind
from hal.errors import DeviceUnavailable, InvalidRequest, Unsupported
from hal.motion import Mover

CLOCK = "clock"  # served objects that are not devices; device names in a cell file cannot contain a dot
MOVER = "mover"
PREFIX = "cell."
SWAPPER = "swapper"
BEHIND = "behind."  # prefix of the device behind the emulated wire of the named device

SWAP_TIMEOUT_S = 20.0  # the slowest driver tries for 6 s, and the old device may have to be connected again


class CellConnection(Protocol):
    """A started cell; threads may share it."""

    @property
    def cell(self) -> Cell:
        """The cell file with everything it points to."""
        ...

    @property
    def clock(self) -> Clock:
        """The cell's clock: simulated seconds in a simulated cell. Use `now_s` only: declared motions advance the time."""
        ...

    @property
    def mover(self) -> Mover:
        """The port that executes declared motions.

        Raises:
            Unsupported: the cell has no arm.
        """
        ...

    def device(self, name: str) -> Any:
        """Return the device called `name` in the cell file, with its HAL interface.

        Raises:
            InvalidRequest: there is no such device; the hint gives the nearest name.
            DeviceUnavailable: the cell process is down.
        """
        ...

    def devices_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return all devices of a kind by name, in the order of the cell file."""
        ...

    def behind_wires_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return the devices behind the emulated wires of a kind's devices. Only the evaluation of a mission may use them."""
        ...

    def close(self) -> None:
        """Release the cell; a second call does nothing."""
        ...


def check_name(cell: Cell, name: str) -> None:
    """Raise `InvalidRequest` unless the cell file has a device called `name`."""
    names = list(cell.file.devices)
    if name in names:
        return
    near = get_close_matches(name, names, n=1)
    raise InvalidRequest(
        f"cell {cell.name!r} has no device called {name!r}",
        hint=f"did you mean {near[0]!r}?" if near else f"devices: {', '.join(names)}",
    )


def emulated(cell: Cell, kind: DeviceKind) -> list[str]:
    """Return the names of the devices of a kind whose wires the cell emulates."""
    return [name for name in cell.names_of(kind) if name in cell.file.emulators]


class LocalConnection:
    """A cell in this process (`inline`)."""

    def __init__(self, cell: Cell, objects: Mapping[str, Any], *, close: Callable[[], None]) -> None:
        self.cell = cell
        self._objects = objects
        self._close = close

    @property
    def clock(self) -> Clock:
        """The cell's clock."""
        return cast(Clock, self._objects[PREFIX + CLOCK])

    @property
    def mover(self) -> Mover:
        """The port that executes declared motions."""
        return _mover_or_raise(self.cell, self._objects.get(PREFIX + MOVER))

    def device(self, name: str) -> Any:
        """Return the device itself."""
        check_name(self.cell, name)
        return self._objects[name]

    def devices_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return the devices themselves."""
        return {name: self._objects[name] for name in self.cell.names_of(kind)}

    def behind_wires_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return the devices behind emulated wires."""
        return {name: self._objects[PREFIX + BEHIND + name] for name in emulated(self.cell, kind)}

    def swap(self, name: str, section: DeviceSection) -> None:
        """Replace the device called `name`; see `service.processes.device_slots.Swapper`."""
        deadline = Deadline.after(WallClock(), SWAP_TIMEOUT_S)
        self._objects[PREFIX + SWAPPER].swap(name, section.driver, section.options, deadline=deadline)

    def close(self) -> None:
        """Close the cell."""
        self._close()


Connect = Callable[[str], Any]
"""Opens a proxy to a served object by name."""


class RemoteConnection:
    """A cell in another process. A proxy's calls do not wait for each other, so that a slow read delays no other thread."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self._lock = threading.Lock()
        self._connect: Connect | None = None
        self._proxies: dict[str, Any] = {}

    def attach(self, connect: Connect) -> None:
        """Use a new cell process and drop the proxies of an earlier one."""
        self._switch(connect)

    def open(self) -> None:
        """Connect to every device now, so that no first call has to, and each cell process has as many connections."""
        for name in self.cell.file.devices:
            self.device(name)

    def detach(self) -> None:
        """Note that the cell process has ended."""
        self._switch(None)

    @property
    def clock(self) -> Clock:
        """The cell's clock."""
        return cast(Clock, self._proxy(PREFIX + CLOCK))

    @property
    def mover(self) -> Mover:
        """The port that executes declared motions."""
        has_arm = bool(self.cell.names_of(DeviceKind.ARM))
        return _mover_or_raise(self.cell, self._proxy(PREFIX + MOVER) if has_arm else None)

    def device(self, name: str) -> Any:
        """Return a proxy of the device."""
        check_name(self.cell, name)
        return self._proxy(name)

    def devices_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return proxies of the devices."""
        return {name: self._proxy(name) for name in self.cell.names_of(kind)}

    def behind_wires_of(self, kind: DeviceKind) -> dict[str, Any]:
        """Return proxies of the devices behind emulated wires."""
        return {name: self._proxy(PREFIX + BEHIND + name) for name in emulated(self.cell, kind)}

    def swap(self, name: str, section: DeviceSection) -> None:
        """Replace the device called `name` and drop its proxies; see `service.processes.device_slots.Swapper`."""
        deadline = Deadline.after(WallClock(), SWAP_TIMEOUT_S)
        self._proxy(PREFIX + SWAPPER).swap(name, section.driver, section.options, deadline=deadline)
        self.cell.file.devices[name] = section
        with self._lock:
            old = self._proxies.pop(name, None)
        _close_link(old)

    def close(self) -> None:
        """Close all proxies."""
        self.detach()

    def _switch(self, connect: Connect | None) -> None:
        with self._lock:
            self._connect = connect
            old, self._proxies = self._proxies, {}
        for proxy in old.values():
            _close_link(proxy)

    def _proxy(self, name: str) -> Any:
        with self._lock:
            known, connect = self._proxies.get(name), self._connect
        if known is not None:
            return known
        if connect is None:
            raise DeviceUnavailable(
                f"{name.removeprefix(PREFIX)} is unavailable: the cell process is not running",
                hint="wait for its restart; `GET /readyz` and the terminal of `panelwright serve` say why",
                device=name.removeprefix(PREFIX),
            )
        proxy = connect(name)
        with self._lock:
            is_present = self._connect is connect
            kept = self._proxies.setdefault(name, proxy) if is_present else proxy
        if kept is not proxy:  # another thread was faster
            _close_link(proxy)
        return kept


def _close_link(proxy: Any) -> None:
    """Close the connection of a proxy, not the device that it stands for."""
    link = getattr(type(proxy), "disconnect", None)
    if link is not None:
        link(proxy)


def _mover_or_raise(cell: Cell, mover: Any) -> Mover:
    if mover is None:
        raise Unsupported(
            f"cell {cell.name!r} has no arm, so nothing can move",
            hint="add a device of kind 'arm' to the cell file",
        )
    return cast(Mover, mover)
