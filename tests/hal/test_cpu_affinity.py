"""Tests which core a thread is pinned to, and that only this thread is pinned."""

from __future__ import annotations

import os
import threading

import pytest

from hal.cpu_affinity import share_core

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no core affinity")


def cores_of_a_thread_for(owner_pid: int) -> set[int]:
    seen: list[set[int]] = []

    def join() -> None:
        share_core(owner_pid)
        seen.append(os.sched_getaffinity(0))

    thread = threading.Thread(target=join)
    thread.start()
    thread.join()
    return seen[0]


def test_two_that_take_turns_meet_on_one_core_and_other_threads_stay_free() -> None:
    before = os.sched_getaffinity(0)
    cores = cores_of_a_thread_for(4711)
    assert len(cores) == 1
    assert cores == cores_of_a_thread_for(4711)
    assert cores <= before == os.sched_getaffinity(0)


def test_neighbouring_owners_are_spread_over_the_cores() -> None:
    number = len(os.sched_getaffinity(0))
    used = set.union(*(cores_of_a_thread_for(pid) for pid in range(100, 100 + number)))
    assert used == os.sched_getaffinity(0)
