"""Clocks and deadlines; the cell's decisions never depend on the time of day."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

IDLE_S = 5.0  # after this long without a tick the world stands still, and the clock follows the wall clock
TICKS_KEPT = 512


class Clock(Protocol):
    """Monotonic clock; `sleep` returns when that much of *this* clock's time has passed."""

    def now_s(self) -> float:
        """Return the seconds since an arbitrary start; never decreases."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` of this clock's time pass; a simulated clock steps its world."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Return the seconds of `time.monotonic`."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Block the calling thread for `duration_s`."""
        if duration_s > 0.0:
            time.sleep(duration_s)


class SimClock:
    """A clock that a simulator controls: `advance` steps the world and moves the time.

    Args:
        advance: called with the seconds to pass; returns the new time in seconds. None makes a free-running test clock.
    """

    def __init__(self, advance: Callable[[float], float] | None = None, *, start_s: float = 0.0) -> None:
        self._advance = advance
        self._now_s = start_s
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Return the simulated seconds since the start of the world."""
        return self._now_s

    def attach(self, advance: Callable[[float], float]) -> None:
        """Connect this clock to a world; called once, when the first simulated device connects."""
        self._advance = advance

    def set_now_s(self, now_s: float) -> None:
        """Set the clock to the world's time; it never decreases."""
        self._now_s = max(self._now_s, now_s)

    def sleep(self, duration_s: float) -> None:
        """Step the world by `duration_s`."""
        if duration_s <= 0.0:
            return
        with self._lock:
            end_s = self._now_s + duration_s
            self.set_now_s(self._advance(duration_s) if self._advance else end_s)


class PacedClock:
    """The time of a simulated world that never runs ahead of the wall clock (mode `mixed`).

    While the world is stepped, this is the world's time: on a slow machine the time slows down, so that set-points do not
    run ahead of a world that lags behind. Without steps, it follows the wall clock, so that deadlines still expire.
    """

    def __init__(self, advance: Callable[[float], float] | None = None) -> None:
        self._advance = advance
        self._lock = threading.Lock()
        self._now_s = time.monotonic()
        self._ticked_at_s = self._now_s - IDLE_S  # wall clock; until the first tick the time follows it
        self._ticking = 0
        self._ticks: deque[tuple[float, float]] = deque(maxlen=TICKS_KEPT)  # (wall, this clock) at the end of each

    def attach(self, advance: Callable[[float], float]) -> None:
        """Connect this clock to a world."""
        self._advance = advance

    def now_s(self) -> float:
        """Return the time in seconds; never decreases."""
        with self._lock:
            return self._present_s()

    def sleep(self, duration_s: float) -> None:
        """Step the world by `duration_s`, then wait until the wall clock has caught up."""
        if duration_s <= 0.0:
            return
        with self._lock:
            self._now_s = self._present_s()
            self._ticking += 1
        end_s = time.monotonic() + duration_s
        try:
            if self._advance is not None:
                self._advance(duration_s)
            time.sleep(max(0.0, end_s - time.monotonic()))
        finally:
            with self._lock:
                self._now_s += duration_s
                self._ticking -= 1
                self._ticked_at_s = time.monotonic()
                self._ticks.append((self._ticked_at_s, self._now_s))

    def at_s(self, wall_s: float) -> float:
        """Return this clock's time when `time.monotonic` was `wall_s`; before its stored ticks it follows the wall clock.

        The age of data on a link between a cell and its simulated world is measured in this time, because a slow
        machine delays the frames and the world equally.
        """
        with self._lock:
            if wall_s >= self._ticked_at_s:
                return self._present_s(wall_s)
            for ticked_s, now_s in reversed(self._ticks):
                if ticked_s <= wall_s:
                    return now_s
            first_s, then_s = self._ticks[0] if self._ticks else (self._ticked_at_s, self._now_s)
            return then_s - max(0.0, first_s - wall_s)

    def _present_s(self, wall_s: float | None = None) -> float:
        if self._ticking:
            return self._now_s
        wall_s = time.monotonic() if wall_s is None else wall_s
        return self._now_s + max(0.0, wall_s - self._ticked_at_s - IDLE_S)


@dataclass(frozen=True, slots=True)
class Deadline:
    """A time on a clock by which a call must have returned, including its retries."""

    at_s: float
    clock: Clock

    @classmethod
    def after(cls, clock: Clock, duration_s: float) -> Deadline:
        """Return the deadline `duration_s` from now."""
        return cls(clock.now_s() + duration_s, clock)

    def remaining_s(self) -> float:
        """Return the seconds left, never negative."""
        return max(0.0, self.at_s - self.clock.now_s())

    def is_past(self) -> bool:
        """Return whether the deadline has passed."""
        return self.clock.now_s() >= self.at_s
