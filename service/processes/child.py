"""Child processes that cannot outlive their parent: their standard input is a pipe that only the parent holds open."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import IO, NoReturn

from hal.child_python import module_command

GRACE_S = 3.0
LAST_WORDS_S = 1.0


class Child:
    """A Python module in a process and a process group of its own.

    It does not receive the terminal's Ctrl-C, and killing its group also ends its children. It stays in the session of its parent,
    so that Linux compares their threads with each other (`hal/priorities.py`).

    Args:
        module: name of the module, run as by `python -m` without the current folder on the import path.
        arguments: command-line arguments. They must not hold secrets, because other users can read them.
        pass_fds: file descriptors that it inherits.
        environment: variables in addition to those of this process.
        on_line: called with each line that it prints, from a reader thread.
        on_exit: called once with its exit code, from another thread.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        *,
        pass_fds: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
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
            env={**os.environ, **(environment or {})},
            process_group=0,
        )
        self._lock = threading.Lock()
        self._is_killed = False
        # Two threads: a grandchild may hold standard output open after the child's death, which must not hide it.
        self._reader = threading.Thread(target=self._read, args=(on_line,), name=f"read-{module}", daemon=True)
        self._reader.start()
        threading.Thread(target=self._wait, args=(on_exit,), name=f"wait-{module}", daemon=True).start()

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def is_alive(self) -> bool:
        """Whether the child is running."""
        return self._process.poll() is None

    def write_line(self, line: str) -> bool:
        """Send a line to its standard input; returns False when the child has ended."""
        with self._lock:
            try:
                stdin = _opened(self._process.stdin)
                stdin.write(line.encode() + b"\n")
                stdin.flush()
            except (OSError, ValueError):
                return False
        return True

    def end(self, *, grace_s: float = GRACE_S) -> None:
        """Close its standard input, wait at most `grace_s`, then kill it and its children. A second call does nothing."""
        with self._lock, contextlib.suppress(OSError):
            _opened(self._process.stdin).close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        self.kill()

    def kill(self) -> None:
        """Kill it and all its children at once; the children are killed even when it has ended already."""
        if self._is_killed:
            return  # its process id may belong to another process by now
        self._is_killed = True
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)

    def hear_last_words(self) -> None:
        """Wait a moment until all lines of a child that has ended were delivered."""
        self._reader.join(LAST_WORDS_S)

    def _read(self, on_line: Callable[[str], None]) -> None:
        for line in _opened(self._process.stdout):
            on_line(line.decode("utf-8", "replace").rstrip("\n"))

    def _wait(self, on_exit: Callable[[int], None]) -> None:
        code = self._process.wait()
        self.hear_last_words()
        on_exit(code)


def _opened(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None  # noqa: S101 - narrowing: both were asked for as pipes
    return stream


class Lifeline:
    """The child's side of the connection: reads lines from the parent and notices when the parent ends.

    Standard output is redirected so that a library that prints cannot corrupt the messages to the parent; prints go to
    standard error.
    """

    def __init__(self) -> None:
        self._out = os.fdopen(os.dup(1), "w", buffering=1)
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def read_line(self) -> str | None:
        """Return the next line from the parent; None when the parent has ended."""
        line = sys.stdin.readline()
        return line.rstrip("\n") if line else None

    def write_line(self, line: str) -> None:
        """Send a line to the parent; does nothing when the parent has ended."""
        with self._lock, contextlib.suppress(OSError, ValueError):
            self._out.write(line + "\n")

    def wait_for_end(self) -> None:
        """Return when the parent closes the lifeline or dies."""
        while self.read_line() is not None:
            pass


def kill_own_group() -> NoReturn:
    """Kill this process and all its children at once. The process must lead its group."""
    if os.getpgrp() == os.getpid():
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)
