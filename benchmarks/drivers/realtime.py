"""Runs a measurement at real-time priority, so that other work on the machine does not disturb it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

REALTIME = 10  # as `chrt -r 10`
PRIORITIES = ((0, "ordinary"), (REALTIME, "real-time"))


@contextmanager
def realtime(priority: int, far_pid: int) -> Iterator[bool]:
    """Give this thread, the threads that it starts, and an emulator's process real-time priority in the `with` block.

    Args:
        priority: 0 to change nothing.

    Yields whether the system permits it.
    """
    tasks = [0, *(int(entry.name) for entry in Path(f"/proc/{far_pid}/task").iterdir())]
    try:
        for task in tasks if priority else ():
            os.sched_setscheduler(task, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
