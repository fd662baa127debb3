"""Tells a silent process that hangs from one that computes and from one for which the machine has no time.

This module imports little, because the stop process must start fast and stay small.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from hal.process_state import ThreadTimes, thread_times, threads_of

STEP_S = 0.015  # looks that follow closer add nothing
LONGEST_STEP_S = 0.03  # of a longer gap between two looks only this counts: the observer itself was kept waiting
BUSY_SHARE = 0.5
AGAIN_S = 0.0005  # a thread that only waits for the lock of Python wakes for a shorter time
WAITED_S = 0.002  # a thread that waited longer for a processor since the last look shows that the machine is busy
WAITING = "D"
RUNNABLE = "R"


@dataclass(frozen=True, slots=True, kw_only=True)
class Conduct:
    """What a silent process has done since its silence was first looked at.

    Attributes:
        still_s: time between looks at which it computed little and none of its threads could run, all in all.
        wakes: turns that the thread of the heartbeat had in that time. While it waits for the lock of Python it wakes again
            and again to ask for it, and while it sleeps between two heartbeats it does not.
        asleep_s: how long up to the newest look it stood still without a break, on a machine that was free.
        computed_s: how long it computed.
    """

    still_s: float = 0.0
    wakes: int = 0
    asleep_s: float = 0.0
    computed_s: float = 0.0


class Hang:
    """Adds up what a silent process does, from one look to the next; several threads may look.

    A thread that sleeps while it holds the lock of Python, or all threads that wait for each other, compute nothing and wait
    for no processor. A process that the machine is too busy for has a thread that could run and gets no processor. Sleep
    alone says little: where a virtual machine gets no processor of its host, no thread is woken in time.

    Args:
        threads: returns the threads of a process by id.
        thread: returns one of them, or None when it has ended.
        now_s: a monotonic clock.
    """

    def __init__(
        self,
        threads: Callable[[int], dict[int, ThreadTimes]] = threads_of,
        thread: Callable[[int, int], ThreadTimes | None] = thread_times,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._threads, self._thread, self._now_s = threads, thread, now_s
        self._lock = threading.Lock()
        self._pid = 0
        self._before: dict[int, ThreadTimes] = {}
        self._looked_s = 0.0
        self._conduct = Conduct()

    def forget(self) -> None:
        """Begin again, because the process has given a heartbeat."""
        self._pid = 0

    def look(self, pid: int, beating: int) -> Conduct:
        """Return what the process with this id has done since the first look; `beating` is its thread of the heartbeat."""
        with self._lock:
            now_s = self._now_s()
            if pid != self._pid:
                self._pid, self._looked_s, self._conduct = pid, now_s, Conduct()
                self._before = self._threads(pid)
            elif now_s - self._looked_s >= STEP_S:
                self._add(pid, beating, min(now_s - self._looked_s, LONGEST_STEP_S))
                self._looked_s = now_s
            return self._conduct

    def _add(self, pid: int, beating: int, step_s: float) -> None:
        before, now = self._before, self._threads(pid)
        self._before = now
        both = [(before[name], now[name]) for name in now if name in before]
        if not both:  # the operating system does not tell
            return
        computed_s = sum(after.computed_s - first.computed_s for first, after in both)
        waits_s = [after.waited_s - first.waited_s for first, after in both]
        is_busy = max(computed_s, sum(waits_s)) > BUSY_SHARE * step_s or len(both) < len(now)
        is_waiting = any(times.state == WAITING for times in now.values())
        is_still = not is_busy and not is_waiting and not self._could_run(pid, before, now)
        wakes = now[beating].turns - before[beating].turns if beating in now and beating in before else 0
        last = self._conduct
        self._conduct = Conduct(
            still_s=last.still_s + is_still * step_s,
            wakes=last.wakes + is_still * wakes,
            asleep_s=last.asleep_s + step_s if is_still and max(waits_s) <= WAITED_S else 0.0,
            computed_s=last.computed_s + min(computed_s, step_s),
        )

    def _could_run(self, pid: int, before: dict[int, ThreadTimes], now: dict[int, ThreadTimes]) -> bool:
        """Return whether a thread waits for a processor since the last look, or runs or waits both now and a moment later."""
        runnable = [name for name, times in now.items() if times.state == RUNNABLE]
        if not runnable:
            return False
        if any(name in before and now[name].turns == before[name].turns for name in runnable):
            return True  # it has waited for its turn, and may have it in this moment
        threading.Event().wait(AGAIN_S)
        later = [self._thread(pid, name) for name in runnable]
        return any(times is not None and times.state == RUNNABLE for times in later)
