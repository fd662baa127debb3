"""What a machine's other work does to a figure, and how a figure is measured without it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

REALTIME = 10  # as `chrt -r 10`
PRIORITIES = ((0, "ordinary"), (REALTIME, "real-time"))


@contextmanager
def realtime(priority: int, far_pid: int) -> Iterator[bool]:
    """Give this thread, those that it starts, and a far side's process a real-time priority, and take it back.

    Args:
        priority: 0 changes nothing.

    Yields whether the system allows it.
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
