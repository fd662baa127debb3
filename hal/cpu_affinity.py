"""Run two threads that only ever wait for each other on one core."""

from __future__ import annotations

import os


def share_core(owner_pid: int) -> None:
    """Pin the calling thread to the core that `owner_pid` selects; does nothing where the system has no affinity.

    A simulated cell's control thread and its world take turns and never work at once. On two cores each turn wakes an
    idle core, which costs more than the turn itself: on one core the loop runs 1.2 to 1.5 times as fast. Different
    processes select different cores as far as there are any.

    Args:
        owner_pid: the process whose thread and child take turns; both pass the same number.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[owner_pid % len(cores)]})
