"""Where two that only ever wait for each other should run: on one core."""

from __future__ import annotations

import os


def share_core(owner_pid: int) -> None:
    """Put the calling thread on the core that belongs to a process; does nothing where the system cannot.

    A simulated cell's control thread and its world take turns and never work at once. On two cores each turn wakes an
    idle core, which costs more than the turn: on one core the loop runs 1.2 to 1.5 times as fast. Another process has
    another core, as far as there are any.

    Args:
        owner_pid: of the process whose thread and child take turns; both give the same.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[owner_pid % len(cores)]})
