"""The service under test: a process of its own on free ports, which is started again as an init system would."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from hal.child_python import module_command
from hal.errors import CellError, DeviceUnavailable
from service.chaos.family import Process, family_of, process_of, roles_of
from service.client import Client

PAUSE_S = 0.05
END_S = 8.0
Command = Callable[[int, int, Path], Sequence[str]]
"""Returns the command line of a service for an HTTP port, a stop port and a folder for runs."""


def serve_command(cell: Path, seed: int | None) -> Command:
    """Return the command line of `panelwright serve` for a cell file."""

    def command(port: int, stop_port: int, runs: Path) -> Sequence[str]:
        given = ["--cell", str(cell), "--port", str(port), "--stop-port", str(stop_port), "--runs", str(runs)]
        return module_command("service.cli", "serve", *given, *([] if seed is None else ["--seed", str(seed)]))

    return command


@dataclass(slots=True, kw_only=True, eq=False)
class Plant:
    """One service, one life after the other, on the same folder.

    Attributes:
        life: number of the present life, from 1.
        lines: what it printed.
        seen: all its processes that are known.
        key: the key with which it is asked, where it has keys.
        orphans: processes that were found to outlive it; `sweep` kills them too.
    """

    command: Command
    runs: Path
    life: int = 0
    lines: list[str] = field(default_factory=list)
    port: int = 0
    stop_port: int = 0
    seen: dict[int, Process] = field(default_factory=dict)
    key: str | None = None
    orphans: list[Process] = field(default_factory=list)
    _process: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int:
        """Process id of the service in its present life; 0 before the first."""
        return 0 if self._process is None else self._process.pid

    def client(self, timeout_s: float = 10.0) -> Client:
        """Return a client of the main port."""
        return Client(url=f"http://127.0.0.1:{self.port}", timeout_s=timeout_s, key=self.key)

    def stop_client(self, timeout_s: float = 2.0) -> Client:
        """Return a client of the stop port."""
        return Client(url=f"http://127.0.0.1:{self.stop_port}", timeout_s=timeout_s)

    def start(self) -> None:
        """Start the service."""
        self.port, self.stop_port = _free_ports()
        self.life += 1
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            self.command(self.port, self.stop_port, self.runs),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            process_group=0,  # Ctrl-C is for the judge
        )
        threading.Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()

    def is_alive(self) -> bool:
        """Return whether the process of the service runs."""
        return self._process is not None and self._process.poll() is None

    def is_ready(self) -> bool:
        """Return whether the service says that its cell runs."""
        try:
            return bool(self.client(2.0).get("/readyz")["is_running"])
        except CellError:
            return False

    def await_ready(self, timeout_s: float) -> float:
        """Wait until the cell runs; returns the seconds that it took.

        Raises:
            DeviceUnavailable: it did not come.
        """
        begun_s = time.monotonic()
        while not self.is_ready():
            waited_s = time.monotonic() - begun_s
            if not self.is_alive() or waited_s > timeout_s:
                last = self.lines[-1].strip() if self.lines else "nothing"
                raise DeviceUnavailable(
                    f"the service was not ready after {waited_s:.0f} s; it printed last: {last}",
                    hint="see the log beside the table",
                )
            time.sleep(PAUSE_S)
        return time.monotonic() - begun_s

    def roles(self) -> dict[str, Process]:
        """Return its processes by role, and remember all of them."""
        self.seen |= family_of(self.pid)
        return roles_of(self.pid)

    def end(self, number: signal.Signals = signal.SIGTERM) -> float:
        """Send a signal to the service alone and wait for its end; returns the seconds until it and its family are gone.

        What is left after `END_S` stays in `survivors`.
        """
        self.roles()
        begun_s = time.monotonic()
        if self._process is not None and self.is_alive():
            os.kill(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
        while time.monotonic() - begun_s < END_S and self.survivors():
            time.sleep(PAUSE_S)
        return time.monotonic() - begun_s

    def survivors(self) -> list[Process]:
        """Return the processes of all lives that still exist, without those of a service that runs."""
        family = family_of(self.pid) if self.is_alive() else {}
        return [one for pid, one in self.seen.items() if family.get(pid) != one and one.is_alive()]

    def sweep(self) -> None:
        """Kill everything that is left of this service."""
        for one in (*self.seen.values(), *self.orphans):
            if process_of(one.pid) == one:
                _signal(one, signal.SIGKILL)
        if self._process is not None:
            self._process.wait(END_S)

    def state_of(self, task_id: str) -> dict[str, Any] | None:
        """Return a task; None when the service does not answer or does not know it."""
        try:
            return dict(self.client().get(f"/v1/tasks/{task_id}"))
        except CellError:
            return None

    def _listen(self, out: IO[str] | None) -> None:
        for line in out or ():
            self.lines.append(line)


def _signal(process: Process, number: signal.Signals) -> bool:
    """Send a signal to a process if it is still the same one; returns whether it was sent."""
    if not process.is_alive():
        return False
    try:
        os.kill(process.pid, number)
    except ProcessLookupError:
        return False
    return True


def _free_ports() -> tuple[int, int]:
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as second:
        return int(first.getsockname()[1]), int(second.getsockname()[1])
