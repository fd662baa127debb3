"""Child processes that cannot outlive their parent: their standard input is a pipe that only the parent holds open."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import IO

from hal.child_python import module_command

GRACE_S = 3.0
LAST_WORDS_S = 1.0


class Child:
    """A Python module in a process and a session of its own.

    Being a session leader it does not get the terminal's Ctrl-C, and killing its group takes its own children along.

    Args:
        module: run as by `python -m`, without the current folder on its import path.
        arguments: its command line; never secrets.
        pass_fds: descriptors that it inherits.
        on_line: called with each line that it prints, from a thread of this object.
        on_exit: called once with its exit code, from another.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        *,
        pass_fds: Sequence[int] = (),
        on_line: Callable[[str], None],
        on_exit: Callable[[int], None],
    ) -> None:
        self.module = module
        self.started_s = time.monotonic()
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            module_command(module, *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=tuple(pass_fds),
            start_new_session=True,
        )
        self._lock = threading.Lock()
        self._is_killed = False
        # Two threads: a grandchild may hold standard output open after the child's death, which must not hide it.
        self._reader = threading.Thread(target=self._read, args=(on_line,), name=f"read-{module}", daemon=True)
        self._reader.start()
        threading.Thread(target=self._wait, args=(on_exit,), name=f"wait-{module}", daemon=True).start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Does it run?"""
        return self._process.poll() is None

    def write_line(self, line: str) -> bool:
        """Send a line to its standard input; False when it is gone."""
        with self._lock:
            try:
                stdin = _opened(self._process.stdin)
                stdin.write(line.encode() + b"\n")
                stdin.flush()
            except (OSError, ValueError):
                return False
        return True

    def end(self, *, grace_s: float = GRACE_S) -> None:
        """Close its lifeline, wait a bounded time, then kill it with all its children. A second call does nothing."""
        with self._lock, contextlib.suppress(OSError):
            _opened(self._process.stdin).close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        self.kill()

    def kill(self) -> None:
        """Kill it and everything it started, at once. What it started is killed even when it is dead already."""
        if self._is_killed:
            return  # its number may belong to somebody else by now
        self._is_killed = True
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)

    def _read(self, on_line: Callable[[str], None]) -> None:
        for line in _opened(self._process.stdout):
            on_line(line.decode("utf-8", "replace").rstrip("\n"))

    def _wait(self, on_exit: Callable[[int], None]) -> None:
        code = self._process.wait()
        self._reader.join(LAST_WORDS_S)  # what it said before it died comes first
        on_exit(code)


def _opened(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None  # noqa: S101 - narrowing: both were asked for as pipes
    return stream


class Lifeline:
    """The child's side: lines from the parent, and an end when the parent is gone.

    Standard output is moved away, so that a library that prints cannot garble the line to the parent; prints go to
    standard error.
    """

    def __init__(self) -> None:
        self._out = os.fdopen(os.dup(1), "w", buffering=1)
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def read_line(self) -> str | None:
        """The next line from the parent; None when the parent is gone."""
        line = sys.stdin.readline()
        return line.rstrip("\n") if line else None

    def write_line(self, line: str) -> None:
        """Tell the parent; a parent that is gone does not matter here."""
        with self._lock, contextlib.suppress(OSError, ValueError):
            self._out.write(line + "\n")

    def wait_for_end(self) -> None:
        """Return when the parent closes the lifeline or dies."""
        while self.read_line() is not None:
            pass


def kill_own_group() -> None:
    """End this process and everything it started, now. Only for a session leader."""
    if os.getpgrp() == os.getpid():
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)
