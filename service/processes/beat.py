"""Heartbeats in shared memory: each process of a cell shows that it lives, and the others notice when it does not.

This module imports little, because the stop process must start fast and stay small.
"""

from __future__ import annotations

import mmap
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hal.process_state import ProcessState, process_state
from service.processes.hang import Conduct, Hang

PERIOD_S = 0.02
BEGIN_S = 0.03  # of an older heartbeat the reader begins to watch what the process does
LOOK_S = 0.06  # an older heartbeat makes the reader ask the operating system for the state of the process
SILENCE_S = 4.0  # a process that has little of a busy machine may be this late
PAUSE_S = 180.0  # a declared pause is no longer: one kernel compiles in a minute on a busy machine
# A silent process hangs that stands still for so long, while its heartbeat asks for the lock of Python at least this share as
# often as a thread does that waits for it.
STILL_S, ASKING_SHARE = 0.04, 0.5
LEAST_INTERVAL_S = 1e-4  # of asking; where none is told yet, nothing is said to hang
ASLEEP_S = 1.0  # so does one of which no thread moves for so long; shorter standstills are those of the machine
COMPUTING_S = {"service": 1.0}  # a silent process may compute for so long: a large answer in JSON takes 0.2 s
COMPUTING_OTHERS_S = 0.3
SIZE = 40
NAMES = ("service", "cell", "stop")


class Beat:
    """A heartbeat: one process writes its monotonic time and its ids, others read them.

    Args:
        folder: runtime folder of the service.
        name: whose heartbeat this is: `service`, `cell` or `stop`.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._computing_s = COMPUTING_S.get(name, COMPUTING_OTHERS_S)
        self._hang = Hang()
        path = folder / f"beat-{name}"
        if not path.exists():
            path.write_bytes(b"\0" * SIZE)
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)
        # Views write a word at once; `struct.pack_into` clears its bytes first, so another process may read a zero.
        self._at_s = memoryview(self._memory)[:8].cast("d")
        self._pid = memoryview(self._memory)[8:16].cast("Q")
        self._pause_ends_s = memoryview(self._memory)[16:24].cast("d")
        self._thread = memoryview(self._memory)[24:32].cast("Q")
        self._asks_after_s = memoryview(self._memory)[32:40].cast("d")

    def pause(self, begins: bool) -> None:
        """Declare that this process gives no heartbeat for a while, or that it goes on; see `hal.pauses`."""
        try:
            self._stamp()  # before the end of a pause, so that no reader takes the pause for silence
            self._pause_ends_s[0] = time.monotonic() + PAUSE_S if begins else 0.0
        except ValueError:
            pass  # closed: this process ends

    def beat(self) -> None:
        """Write the current time; always called by the same thread, at which readers look when it is late."""
        self._thread[0] = threading.get_native_id()
        self._asks_after_s[0] = sys.getswitchinterval()
        self._stamp()

    def _stamp(self) -> None:
        if self._pid[0] != os.getpid():
            self._pid[0] = os.getpid()
        self._at_s[0] = time.monotonic()

    def age_s(self) -> float:
        """Return the seconds since the last heartbeat; both processes share the machine's monotonic clock."""
        return time.monotonic() - float(self._at_s[0])

    def lost(self, *, silence_s: float) -> str | None:
        """Return how the process was lost, as in "has ended"; None while it lives, and before its first heartbeat.

        A process that has ended or is suspended is noticed after 0.06 s, and one whose heartbeat waits for the lock of Python
        after 0.1 s, if no other thread runs, or waits for a processor or a disk. A process of which no thread does anything
        is lost after 1 s, one that computes all the time and gives no heartbeat when it has computed for 0.3 s (the service:
        1 s), and any silent process after `silence_s`, unless it has declared a pause. Call it periodically, because a hang
        shows only between two calls.
        """
        try:
            is_paused = time.monotonic() < float(
                self._pause_ends_s[0]
            )  # read before the heartbeat, which a pause renews
            age_s, pid, thread = self.age_s(), int(self._pid[0]), int(self._thread[0])
            asks_after_s = float(self._asks_after_s[0])
        except ValueError:
            return None  # closed: this process ends
        if pid == 0 or age_s < BEGIN_S:
            self._hang.forget()
            return None
        did = Conduct() if is_paused else self._hang.look(pid, thread)
        if age_s < LOOK_S:
            return None
        state = process_state(pid)
        if state is not ProcessState.RUNS:
            return str(state)
        if is_paused:
            return None
        asking = ASKING_SHARE * did.still_s / max(asks_after_s, LEAST_INTERVAL_S)
        if (did.still_s >= STILL_S and did.wakes >= asking) or did.asleep_s >= ASLEEP_S:
            return f"hangs: none of its threads has done anything for {age_s:.2f} s"
        if did.computed_s >= self._computing_s or age_s > silence_s:
            return f"gave no sign of life for {age_s:.1f} s"
        return None

    def close(self) -> None:
        """Unmap the file; a second call does nothing."""
        self._at_s.release()
        self._pid.release()
        self._pause_ends_s.release()
        self._thread.release()
        self._asks_after_s.release()
        self._memory.close()


def every_beat(work: Callable[[], None], *, name: str) -> threading.Event:
    """Call `work` 50 times a second in a thread of its own; returns the event that ends it."""
    end = threading.Event()

    def run() -> None:
        while not end.wait(PERIOD_S):
            work()

    threading.Thread(target=run, name=name, daemon=True).start()
    return end
