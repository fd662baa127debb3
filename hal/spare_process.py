"""Starts Python modules in separate processes: in a spare one that was forked before, or with a new interpreter.

A spare process has every library that its parent had when it was forked, so that a module starts in it without the second
that importing them takes. It must be forked before the parent starts a thread.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import NoReturn, Protocol

from hal.child_python import module_command

ORDER_BYTES = 65536
MOST_FDS = 8
PAUSE_S = 0.005


class Running(Protocol):
    """A process that was started: what `subprocess.Popen` and `ForkedProcess` have in common."""

    @property
    def pid(self) -> int:
        """Process id."""

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while the process runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code; raises `subprocess.TimeoutExpired`."""

    def kill(self) -> None:
        """Kill the process."""

    def send_signal(self, sig: int) -> None:
        """Send a signal to the process."""


class ForkedProcess:
    """A forked child of this process."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal; None while the process runs."""
        with self._lock:
            if self._code is None:
                ended, status = os.waitpid(self.pid, os.WNOHANG)
                if ended:
                    self._code = os.waitstatus_to_exitcode(status)
            return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code.

        Raises:
            subprocess.TimeoutExpired: it has not ended after `timeout` seconds.
        """
        end_s = None if timeout is None else time.monotonic() + timeout
        pause = threading.Event()
        while (code := self.poll()) is None:
            if end_s is not None and time.monotonic() > end_s:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            pause.wait(PAUSE_S)
        return code

    def kill(self) -> None:
        """Kill the process; does nothing after its end."""
        self.send_signal(signal.SIGKILL)

    def send_signal(self, sig: int) -> None:
        """Send a signal to the process; does nothing after its end, when another process may have its number."""
        if self.poll() is None:
            os.kill(self.pid, sig)


class _Spare:
    """A forked process that waits for the module that it becomes, and ends when its parent ends."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        gc.freeze()  # a collection in one process would copy the memory that both share
        pid = os.fork()
        if pid == 0:
            ours.close()
            _wait_and_become(theirs)
        theirs.close()
        self._link = ours
        self.process = ForkedProcess(pid)

    def become(self, module: str, fds: Sequence[int], environment: Mapping[str, str]) -> bool:
        """Let the process run a module; returns False when it has ended."""
        order = json.dumps({"module": module, "environment": dict(environment)}).encode()
        try:
            socket.send_fds(self._link, [order], list(fds))
        except OSError:
            return False
        finally:
            self._link.close()
        return self.process.poll() is None

    def drop(self) -> None:
        """End the process, which was not needed."""
        self._link.close()
        self.process.wait()


_kept: list[_Spare] = []


def keep_spare() -> None:
    """Fork a spare process; the calling process must have no thread but its main one. Only Linux can do this safely."""
    if sys.platform == "linux" and not _kept:
        _kept.append(_Spare())


def drop_spare() -> None:
    """End the spare process if there is one that was not used."""
    while _kept:
        _kept.pop().drop()


def start_module(module: str, fds: Sequence[int], environment: Mapping[str, str]) -> Running:
    """Run `main()` of a module in the spare process, or in a new interpreter if there is none.

    Standard input and output are closed to it.

    Args:
        fds: file descriptors that it inherits; their numbers there are its command-line arguments.
        environment: variables in addition to those of this process.
    """
    while _kept:
        spare = _kept.pop()
        if spare.become(module, fds, environment):
            return spare.process
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        module_command(module, *map(str, fds)),
        pass_fds=tuple(fds),
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )


def _wait_and_become(link: socket.socket) -> NoReturn:
    """Wait in the forked process for its order, run the module, and end the process."""
    code = 1
    try:
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 0)  # the parent's lifeline and its messages are not for this process
        os.dup2(nothing, 1)
        os.close(nothing)
        data, fds, _flags, _address = socket.recv_fds(link, ORDER_BYTES, MOST_FDS)
        link.close()
        if data:
            order = json.loads(data)
            os.environ.update(order["environment"])
            sys.argv = [order["module"], *map(str, fds)]
            import_module(order["module"]).main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # nothing may return into the code of the parent
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)
