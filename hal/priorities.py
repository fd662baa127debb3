"""The table of what runs first where processors are busy; a process needs no privileges for it.

Linux may share the processors between sessions first, and then within each of them (`sched_autogroup_enabled`). The niceness
of a process that leads a session is therefore given to the session, too. Linux gives every thread turns. From version 6.12
on, a thread may ask for short turns: it gets no more time of a processor than before, but when it wakes it interrupts
threads with longer turns instead of waiting until theirs are over.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from contextlib import suppress
from enum import Enum
from pathlib import Path

# struct sched_attr of linux/sched/types.h: size, policy, flags, niceness, priority, runtime (ns), deadline, period
ATTRIBUTES = struct.Struct("=IIQiIQQQ")
SESSION = Path("/proc/self/autogroup")
CALLS = {"x86_64": 314, "aarch64": 274, "riscv64": 274}  # numbers of the system call sched_setattr


class Priority(Enum):
    """What a thread, and every thread or process that it starts later, asks for: added niceness, and length of its turns, s.

    0.1 ms is the shortest turn that Linux gives. Beside a load of 12 on two cores, a control thread at 125 Hz then sent 7 of
    100 set-points late instead of 11; turns of 1 ms changed nothing, nor did more niceness of the service.
    """

    CONTROL = (0, 0.0001)  # the control thread, which has a deadline in every period
    STOP = (-10, 0.0001)  # the stop process; only a privileged process gets the negative niceness
    CLIENT = (5, None)  # console and gateway, which may be late without harm


def take_priority(priority: Priority) -> None:
    """Give the calling thread a priority; what the operating system does not offer or allow stays as it is."""
    more, turn_s = priority.value
    if not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return  # a real-time class, which somebody chose, comes before all of this
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) + more)
    if more and os.getsid(0) == os.getpid():
        with suppress(OSError):  # what a system without this, or without the privilege, says
            SESSION.write_text(str(more))
    call = CALLS.get(platform.machine())
    if turn_s is None or call is None:
        return
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = ATTRIBUTES.pack(ATTRIBUTES.size, os.SCHED_OTHER, 0, niceness, 0, round(1e9 * turn_s), 0, 0)
    ctypes.CDLL(None).syscall(call, 0, attributes, 0)
