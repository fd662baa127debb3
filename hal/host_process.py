"""Runs child processes that serve objects; `hal.isolated` keeps a device in one."""

from __future__ import annotations

import contextlib
import faulthandler
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from hal.errors import CellError, DeviceTimeout, DeviceUnavailable
from hal.host import CONNECT_TIMEOUT_S, connect, new_address, serve

LOOK_S = 0.1  # a request to end the start is noticed within this time
EXIT = "exit"  # key of the error detail that says how a process died


class HostProcess:
    """A child process that makes objects and serves them; it ends with its parent, even if that is killed.

    Args:
        make: importable function that makes the objects in the child; raises CellError when it cannot.
        args: its arguments; they are pickled.
        give_up: set it from another thread to end the start, and the child with it.
        ready_s: how long the start may take.

    Raises:
        CellError: what `make` raised.
        DeviceUnavailable: the child died while starting (`details[EXIT]` says how), or the start was given up.
        DeviceTimeout: it was not ready in time.
    """

    def __init__(
        self,
        make: Callable[..., Mapping[str, object]],
        *args: Any,
        name: str = "host",
        give_up: threading.Event | None = None,
        ready_s: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self._ready_s = ready_s
        self._context = multiprocessing.get_context("spawn")
        self._lifeline, child_end = self._context.Pipe()
        self.address = new_address()
        self._process: BaseProcess = self._context.Process(
            target=_run_host, args=(make, args, self.address, child_end), name=name, daemon=True
        )
        self._process.start()
        child_end.close()
        self._await_ready(name, give_up or threading.Event())

    @property
    def pid(self) -> int | None:
        """Process id of the child."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the child is running."""
        return self._process.is_alive()

    def await_end(self) -> str:
        """Wait until the child ends, and say how: the name of a signal or an exit code. One thread may wait."""
        wait([self._process.sentinel])
        self._process.join(timeout=1.0)
        return self._how_it_ended()

    def proxy(self, name: str) -> Any:
        """Return a proxy for the child's object called `name`."""
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

    def _await_ready(self, name: str, give_up: threading.Event) -> None:
        try:
            error = self._first_word(name, give_up)
        except EOFError:
            self._process.join(timeout=1.0)
            how = self._how_it_ended()
            text = f"the process of {name} died while starting ({how})"
            error = DeviceUnavailable(text, hint="see its last messages in the log above", device=name, **{EXIT: how})
        if error is not None:
            self.close()
            raise error

    def _first_word(self, name: str, give_up: threading.Event) -> CellError | None:
        """Wait until the child is ready; returns the error with which it failed, or None."""
        until_s = time.monotonic() + self._ready_s
        while not self._lifeline.poll(LOOK_S):
            if give_up.is_set():
                return DeviceUnavailable(f"{name} was closed while it started", hint="connect it again", device=name)
            if time.monotonic() > until_s:
                text = f"the process of {name} was not ready in {self._ready_s:.0f} s"
                return DeviceTimeout(text, hint="the machine may be overloaded; see the log", device=name)
        word: CellError | None = self._lifeline.recv()
        return word

    def _how_it_ended(self) -> str:
        code = self._process.exitcode
        return signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"


def _run_host(
    make: Callable[..., Mapping[str, object]], args: tuple[Any, ...], address: str, lifeline: Connection
) -> None:
    faulthandler.enable()  # a crash inside a vendor's library then logs the call
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
    for panel_object in objects.values():
        close = getattr(panel_object, "close", None)
        if close is not None:
            with contextlib.suppress(Exception):  # close the others even if this one fails
                close()
    os._exit(0)  # a driver's stuck thread must not keep the process alive
