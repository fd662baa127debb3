"""Notices a control thread that is blocked in a call of a driver while the rest of the cell process lives."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hal.process_state import ThreadTimes, thread_times

BLOCKED_S = 0.08  # a read waits for 0.02 s at most
BLOCKED_COMMANDING_S = 0.4  # a command may wait for 0.25 s
GIVE_UP_S = 1.5  # an isolated driver that does not answer comes back before this, and its device is named
LONGEST_STEP_S = 0.04  # of a longer gap between two looks only this counts: the observer itself was kept waiting
SLEEPS = "S"


class ControlWatch:
    """Looks whether the control thread has a turn now and then, which it has in each tick on a wall clock.

    A thread that could run and gets no processor is not blocked: the machine is busy. Nor is one that computes.

    Args:
        thread: returns the id of the control thread; None while there is none, or when it may sleep.
        times: returns what a thread has had of the machine.
        now_s: a monotonic clock.
    """

    def __init__(
        self,
        thread: Callable[[], int | None],
        *,
        times: Callable[[int, int], ThreadTimes | None] = thread_times,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._thread, self._times, self._now_s = thread, times, now_s
        self._commands = 0
        self._seen: tuple[int, int] | None = None  # thread and number of its turns
        self._looked_s = now_s()
        self._still_s = 0.0

    def why_blocked(self) -> str | None:
        """Return that the control thread is blocked; None while it is not. Call it periodically."""
        now_s, thread = self._now_s(), self._thread()
        step_s, self._looked_s = min(now_s - self._looked_s, LONGEST_STEP_S), now_s
        times = None if thread is None else self._times(os.getpid(), thread)
        if thread is None or times is None or times.state != SLEEPS or self._seen != (thread, times.turns):
            self._seen = None if thread is None or times is None else (thread, times.turns)
            self._still_s = 0.0
            return None
        self._still_s += step_s
        if self._still_s < (BLOCKED_COMMANDING_S if self._commands else BLOCKED_S):
            return None
        return f"the control thread is blocked: a call of a driver has not come back for {self._still_s:.2f} s"

    def why_ended(self) -> str | None:
        """Return why the cell must be started again: the thread was blocked for so long that it will not come back."""
        return "the control thread is blocked" if self._still_s > GIVE_UP_S else None

    @contextmanager
    def commanding(self) -> Iterator[None]:
        """Allow the longer wait of a command in this context."""
        self._commands += 1
        try:
            yield
        finally:
            self._commands -= 1


class Commanded:
    """A device of which some calls are commands, which may wait longer than a read."""

    def __init__(self, device: Any, watch: ControlWatch, *commands: str) -> None:
        self._device, self._watch, self._commands = device, watch, commands

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._device, name)
        if name not in self._commands:
            return attribute

        def call(*args: Any, **kwargs: Any) -> Any:
            with self._watch.commanding():
                return attribute(*args, **kwargs)

        return call
