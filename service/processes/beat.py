"""Heartbeats in shared memory: each process of a cell shows that it lives, and the others notice when it does not.

This module imports little, because the stop process must start fast and stay small.
"""

from __future__ import annotations

import mmap
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hal.process_state import ProcessState, process_state

PERIOD_S = 0.02
LOOK_S = 0.06  # an older heartbeat makes the reader ask the operating system for the state of the process
SILENCE_S = 4.0  # a process that runs may be this late: a compiler can hold the lock of Python for seconds
SIZE = 16
NAMES = ("service", "cell", "stop")


class Beat:
    """A heartbeat: one process writes its monotonic time and its id, others read them.

    Args:
        folder: runtime folder of the service.
        name: whose heartbeat this is: `service`, `cell` or `stop`.
    """

    def __init__(self, folder: Path, name: str) -> None:
        path = folder / f"beat-{name}"
        if not path.exists():
            path.write_bytes(b"\0" * SIZE)
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)
        # Views write a word at once; `struct.pack_into` clears its bytes first, so another process may read a zero.
        self._at_s = memoryview(self._memory)[:8].cast("d")
        self._pid = memoryview(self._memory)[8:16].cast("Q")

    def beat(self) -> None:
        """Write the current time."""
        if self._pid[0] != os.getpid():
            self._pid[0] = os.getpid()
        self._at_s[0] = time.monotonic()

    def age_s(self) -> float:
        """Return the seconds since the last heartbeat; both processes share the machine's monotonic clock."""
        return time.monotonic() - float(self._at_s[0])

    def lost(self, *, silence_s: float) -> str | None:
        """Return how the process was lost, as in "has ended"; None while it lives, and before its first heartbeat.

        A process that has ended or is suspended is noticed after 0.06 s, a process that runs and gives no heartbeat after
        `silence_s`.
        """
        try:
            age_s, pid = self.age_s(), int(self._pid[0])
        except ValueError:
            return None  # closed: this process ends
        if pid == 0 or age_s < LOOK_S:
            return None
        state = process_state(pid)
        if state is not ProcessState.RUNS:
            return str(state)
        return f"gave no sign of life for {age_s:.1f} s" if age_s > silence_s else None

    def close(self) -> None:
        """Unmap the file; a second call does nothing."""
        self._at_s.release()
        self._pid.release()
        self._memory.close()


def every_beat(work: Callable[[], None], *, name: str) -> threading.Event:
    """Call `work` 50 times a second in a thread of its own; returns the event that ends it."""
    end = threading.Event()

    def run() -> None:
        while not end.wait(PERIOD_S):
            work()

    threading.Thread(target=run, name=name, daemon=True).start()
    return end
