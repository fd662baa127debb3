"""Tests what a thread gets from the table of priorities, by what the operating system says of it."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from hal.priorities import (
    ATTRIBUTES,
    CALLS,
    SESSION,
    SESSION_NICENESS,
    Priority,
    RealtimeUnlessBusy,
    promptly,
    take_priority,
)

pytestmark = pytest.mark.skipif(platform.machine() not in CALLS, reason="the system call is not known here")


def niceness_and_turn_s() -> tuple[int, float]:
    """Return what the operating system says of the calling thread; sched_getattr is the call after sched_setattr."""
    found = ctypes.create_string_buffer(ATTRIBUTES.size)
    ctypes.CDLL(None).syscall(CALLS[platform.machine()] + 1, 0, found, ATTRIBUTES.size, 0)
    _size, _policy, _flags, niceness, _priority, turn_ns, _deadline, _period = ATTRIBUTES.unpack(found.raw)
    return niceness, 1e-9 * turn_ns


def in_a_thread(priority: Priority) -> tuple[int, float]:
    seen: list[tuple[int, float]] = []

    def work() -> None:
        take_priority(priority)
        seen.append(niceness_and_turn_s())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return seen[0]


def test_the_control_thread_has_short_turns_and_its_niceness_stays() -> None:
    niceness, turn_s = niceness_and_turn_s()
    if turn_s == 0.0:
        pytest.skip("this version of Linux has no turns of a chosen length")
    assert in_a_thread(Priority.CONTROL) == pytest.approx((niceness, 0.0001))
    assert niceness_and_turn_s() == (niceness, turn_s)


def test_clients_and_work_are_nicer_than_their_process_also_when_a_nicer_thread_starts_them() -> None:
    niceness = os.getpriority(os.PRIO_PROCESS, os.getpid())
    assert in_a_thread(Priority.CLIENT)[0] == min(19, niceness + 5)
    with ThreadPoolExecutor(1, "work", take_priority, (Priority.WORK,)) as pool:
        assert pool.submit(in_a_thread, Priority.WORK).result()[0] == min(19, niceness + 10)
    assert os.getpriority(os.PRIO_PROCESS, os.getpid()) == niceness


@pytest.mark.parametrize(("priority", "asked"), [(Priority.STOP, 2), (Priority.ANSWERS, 1)])
def test_stop_and_answers_are_real_time_where_that_is_allowed_and_else_keep_their_turns(
    priority: Priority, asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int, int]] = []
    is_allowed = True

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        calls.append((pid, policy, param.sched_priority))
        if not is_allowed:
            raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    plain = niceness_and_turn_s()
    assert in_a_thread(priority) == plain
    is_allowed = False
    niceness, turn_s = in_a_thread(priority)
    assert calls == [(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, asked)] * 2
    may_be_first = os.geteuid() == 0
    assert niceness == (plain[0] - 10 if priority is Priority.STOP and may_be_first else plain[0])
    assert turn_s == (pytest.approx(0.0001) if priority is Priority.STOP and plain[1] else plain[1])


@pytest.mark.parametrize("is_allowed", [True, False])
def test_a_thread_comes_first_for_a_moment_where_that_is_allowed(
    is_allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    policies = [os.SCHED_OTHER]

    def schedule(_pid: int, policy: int, _param: os.sched_param) -> None:
        if not is_allowed:
            raise PermissionError(1, "Operation not permitted")
        policies.append(policy)

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _pid: policies[-1])
    with pytest.raises(ValueError, match="of the caller"), promptly(), promptly():
        raise ValueError("of the caller")
    with promptly():
        pass
    first, later = os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK
    assert policies == [os.SCHED_OTHER, *([first, later, first, later] if is_allowed else [])]


@pytest.mark.parametrize(
    ("begins_as", "busy_as"),
    [
        (os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK),
        (os.SCHED_OTHER,) * 2,
        (os.SCHED_RR,) * 2,
    ],
)
def test_a_thread_without_a_pause_is_real_time_no_more_until_it_pauses(
    begins_as: int, busy_as: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, clock_s, computed_s = begins_as, 0.0, 0.0

    def schedule(_pid: int, asked: int, _param: os.sched_param) -> None:
        nonlocal policy
        policy = asked

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _pid: policy)
    monkeypatch.setattr("time.monotonic", lambda: clock_s)
    monkeypatch.setattr("time.thread_time", lambda: computed_s)
    realtime = RealtimeUnlessBusy()
    found: list[int] = []
    for share in (0.5, 0.9, 0.95, 0.7, 0.1, 1.0):
        clock_s, computed_s = clock_s + 0.1, computed_s + 0.1 * share
        realtime.review()
        found.append(policy)
    assert found == [begins_as, busy_as, busy_as, begins_as, begins_as, busy_as]


def test_a_process_raises_the_session_that_it_leads_and_no_other() -> None:
    program = "from hal.priorities import *; raise_session(); print(SESSION.read_text())"
    try:
        own = SESSION.read_text()
    except OSError:
        pytest.skip("this system does not group sessions")
    if "nice" not in own:
        pytest.skip("this system does not group sessions")
    if os.geteuid() != 0:
        pytest.skip("only a privileged process may raise its session")
    found = [
        subprocess.run(
            [sys.executable, "-c", program], start_new_session=is_leader, capture_output=True, text=True, check=True
        ).stdout.split()[-1]
        for is_leader in (True, False)
    ]
    assert found == [str(SESSION_NICENESS), own.split()[-1]]
