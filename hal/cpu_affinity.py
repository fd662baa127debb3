"""Runs two threads that always wait for each other on the same core."""

from __future__ import annotations

import os


def share_core(owner_pid: int) -> None:
    """Pin the calling thread to the core that `owner_pid` selects; does nothing on a system without CPU affinity.

    The control thread of a simulated cell and its world take turns and never work at the same time. On two cores each
    turn must wake an idle core, which takes longer than the turn itself; on one core the loop runs 1.2 to 1.5 times as
    fast. Different processes select different cores while there are enough.

    Args:
        owner_pid: process whose thread and child process take turns; both pass the same number.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[owner_pid % len(cores)]})
