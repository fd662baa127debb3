"""Child processes that hold objects: a driver whose library holds the interpreter lock gets one (`isolate = true`)."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from hal.clock import WallClock
from hal.config import Cell
from hal.errors import CellError, ConfigError, DeviceTimeout, DeviceUnavailable
from hal.host import CONNECT_TIMEOUT_S, connect, new_address, serve
from hal.registry import Context
from hal.registry import connect as connect_device


class HostProcess:
    """A child process that makes objects and serves them; ends with its parent, however that ends.

    Args:
        make: importable function that makes the objects in the child; raises CellError when it cannot.
        args: its arguments; they are pickled.
    """

    def __init__(self, make: Callable[..., Mapping[str, object]], *args: Any, name: str = "host") -> None:
        self._context = multiprocessing.get_context("spawn")
        self._lifeline, child_end = self._context.Pipe()
        self.address = new_address()
        self._process: BaseProcess = self._context.Process(
            target=_run_host, args=(make, args, self.address, child_end), name=name, daemon=True
        )
        self._process.start()
        child_end.close()
        self._await_ready(name)

    @property
    def pid(self) -> int | None:
        """Process id of the child."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Does the child run?"""
        return self._process.is_alive()

    def proxy(self, name: str) -> Any:
        """A proxy for the child's object called `name`."""
        return connect(self.address, None, name)

    def close(self) -> None:
        """End the child: first politely, then by force. A second call does nothing."""
        self._lifeline.close()
        self._process.join(timeout=3.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(timeout=1.0)
        with contextlib.suppress(OSError):
            Path(self.address).unlink(missing_ok=True)
            Path(self.address).parent.rmdir()

    def _await_ready(self, name: str) -> None:
        error: Exception | None = None
        try:
            if not self._lifeline.poll(CONNECT_TIMEOUT_S):
                error = DeviceTimeout(
                    f"process {name} was not ready in {CONNECT_TIMEOUT_S:.0f} s",
                    hint="the machine may be overloaded; see the log",
                    device=name,
                )
            else:
                error = self._lifeline.recv()
        except EOFError:
            error = DeviceUnavailable(f"process {name} died while starting", hint="see the log above", device=name)
        if error is not None:
            self.close()
            raise error


def _run_host(
    make: Callable[..., Mapping[str, object]], args: tuple[Any, ...], address: str, lifeline: Connection
) -> None:
    try:
        objects = make(*args)
        server = serve(objects, address)
    except CellError as error:
        lifeline.send(error)
        return
    lifeline.send(None)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        lifeline.recv()  # returns only when the parent closes it or dies
    server.close()
    for thing in objects.values():
        close = getattr(thing, "close", None)
        if close is not None:
            with contextlib.suppress(Exception):  # the process ends anyway, and every object gets its turn
                close()
    os._exit(0)  # a driver's stuck thread must not keep the process


class IsolatedDevice:
    """A device in a process of its own, with the interface of its kind; to close it is to end the process."""

    def __init__(self, context: Context, driver: str, options: dict[str, Any]) -> None:
        self._process = HostProcess(_make_device, context.name, context.cell, driver, options, name=context.name)
        hint = "its driver crashed (the log says how); connect it anew: PUT /v1/devices/NAME, or restart the service"
        self._proxy = connect(self._process.address, None, context.name, gone_hint=hint)

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        return getattr(self._proxy, attribute)

    def __dir__(self) -> list[str]:
        return dir(self._proxy)

    def close(self) -> None:
        """Close the device and end its process; a second call does nothing."""
        self._proxy.disconnect()
        self._process.close()


def isolated_device(context: Context, driver: str, options: dict[str, Any]) -> IsolatedDevice:
    """Connect a device in a process of its own.

    Raises:
        ConfigError: a simulated driver shares its world with others, and a clock that is not the wall's is no other
            process's: neither can be isolated.
        CellError: the device did not connect.
    """
    if not driver.startswith("sim:") and isinstance(context.clock, WallClock):
        return IsolatedDevice(context, driver, options)
    raise ConfigError(
        f"devices.{context.name}: {driver} cannot be isolated in a cell with a simulated world",
        hint="remove isolate = true; it is for cell.mode = 'real'",
        key=f"devices.{context.name}.isolate",
    )


def _make_device(name: str, cell: Cell | None, driver: str, options: dict[str, Any]) -> Mapping[str, object]:
    return {name: connect_device(Context(name=name, cell=cell), driver, options)}
