"""The table of what runs first where processors are busy; most of it needs no privileges.

Linux gives every thread turns. From version 6.12 on, a thread may ask for short turns: it gets no more time of a processor than
before, but when it wakes it interrupts threads with longer turns instead of waiting until theirs are over.

Linux may share the processors between sessions first, and then within each of them (`sched_autogroup_enabled`). What a session
that mostly sleeps is owed is reckoned coarsely: a loop at 125 Hz that was alone in its session waited up to 30 ms for its turn, and
up to 6 ms in the session of those that kept the processors busy. All processes of a service therefore share its session.
"""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path

# struct sched_attr of linux/sched/types.h: size, policy, flags, niceness, priority, runtime (ns), deadline, period
ATTRIBUTES = struct.Struct("=IIQiIQQQ")
PROMPT = 1  # real-time priority, as that of the event loop
BUSY_SHARE = 0.8  # of a processor
SESSION = Path("/proc/self/autogroup")
SESSION_NICENESS = -12
CALLS = {"x86_64": 314, "aarch64": 274, "riscv64": 274}  # numbers of the system call sched_setattr
log = logging.getLogger(__name__)


class Priority(Enum):
    """What a thread asks for: niceness in addition to that of its process, length of its turns, s, and real-time priority.

    What it starts later inherits niceness and turns, and is not real-time. Only a privileged process gets a negative niceness or
    a real-time priority.

    0.1 ms is the shortest turn that Linux gives; with 0.5, 1 and 2 ms a control thread at 125 Hz sent more set-points late, not
    fewer. Beside missions and clients on two cores it sent about 5 of 1000 late, and 20 to 40 before work was nicer. Ten browsers
    on the same two cores let the event loop lag 60 ms and a stop take 12 ms (99th percentiles); real-time made that 6 to 21 and
    2 ms.
    """

    CONTROL = (0, 0.0001, 0)  # the control thread, which has a deadline in every period
    STOP = (-10, 0.0001, 2)  # the stop process
    ANSWERS = (0, None, 1)  # the event loop of the service, which answers everybody, and the thread that ends a lease
    CLIENT = (5, None, 0)  # console and gateway, which may be late without harm
    WORK = (10, None, 0)  # tasks, readings and simulated worlds, which compute as much as they are given


def take_priority(priority: Priority) -> None:
    """Give the calling thread a priority; what the operating system does not offer or allow stays as it is."""
    more, turn_s, realtime_priority = priority.value
    if not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return  # a real-time class, which somebody chose, comes before all of this
    if realtime_priority and ask_for_realtime(realtime_priority):
        return
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, os.getpid()) + more)
    call = CALLS.get(platform.machine())
    if turn_s is None or call is None:
        return
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = ATTRIBUTES.pack(ATTRIBUTES.size, os.SCHED_OTHER, 0, niceness, 0, round(1e9 * turn_s), 0, 0)
    ctypes.CDLL(None).syscall(call, 0, attributes, 0)


@contextmanager
def promptly() -> Iterator[None]:
    """Let the calling thread come before all that computes, where that is allowed; for a few milliseconds of work at a time.

    A thread of a task that stores a reading waited 1.4 ms for a processor in the median, and 4 ms in one of a hundred times.
    """
    policy = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
    if policy is None or policy & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
        yield  # a real-time class comes before what computes anyway
        return
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(PROMPT))
    try:
        yield
    finally:
        with suppress(OSError):  # only a privileged process may take back RESET_ON_FORK, which does no harm
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


class RealtimeUnlessBusy:
    """Takes the calling thread's real-time priority from it while it hardly pauses, and gives it back afterwards.

    Linux keeps 50 ms of each second for threads without such a priority, and takes them in one piece: an event loop that answered
    as many requests as it could let one of a hundred wait 36 ms, and 10 ms as a thread like others. A thread without real-time
    priority keeps what it has.
    """

    def __init__(self) -> None:
        ours = os.SCHED_RR | os.SCHED_RESET_ON_FORK if hasattr(os, "sched_getscheduler") else None
        self._is_ours = (
            ours is not None and os.sched_getscheduler(0) == ours
        )  # a class that somebody chose has no such flag
        self._had_s, self._begun_s = time.thread_time(), time.monotonic()

    def review(self) -> None:
        """Compare what the thread computed since the last call with the time since; the thread itself calls this regularly."""
        if not self._is_ours:
            return
        has_s, now_s = time.thread_time(), time.monotonic()
        is_busy = has_s - self._had_s > BUSY_SHARE * (now_s - self._begun_s)
        self._had_s, self._begun_s = has_s, now_s
        policy, priority = (os.SCHED_OTHER, 0) if is_busy else (os.SCHED_RR, PROMPT)
        if os.sched_getscheduler(0) != policy | os.SCHED_RESET_ON_FORK:
            with suppress(OSError):
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def raise_session() -> None:
    """Let the session that this process leads come before those of other programs, if the system knows this and permits it.

    Threads of one Python process wait for the one that computes, also those with a real-time priority. Beside ten browsers on the
    same two cores, 30 of 1000 timers of the event loop were more than 10 ms late during a mission, 14 with a niceness of -10, and
    8 with -20. That is the niceness of the workers that complete writes to a disk, which then wait up to 4 ms for their turn.
    """
    if os.getsid(0) != os.getpid():
        return  # the session of a person's shell, in which much else may run
    with suppress(OSError):
        SESSION.write_text(str(SESSION_NICENESS))


def ask_for_realtime(priority: int) -> bool:
    """Request real-time scheduling for the calling thread; return whether the system allowed it.

    Linux requires CAP_SYS_NICE or an rtprio limit. Threads and processes started by this thread do not inherit it.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (AttributeError, OSError) as error:
        log.info("no real-time priority for %s: %s", threading.current_thread().name, error)
        return False
    return True
