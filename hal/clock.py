"""Clocks and deadlines. Nothing in the cell asks the wall for the time of day."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

IDLE_S = 5.0  # a paced world that nobody has ticked for this long stands still; time passes without it
TICKS_KEPT = 512


class Clock(Protocol):
    """Monotonic seconds. `sleep` returns when that much of *this* clock's time has passed."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` of this clock's time pass; a simulated clock steps its world."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Seconds of `time.monotonic`."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Block the calling thread."""
        if duration_s > 0.0:
            time.sleep(duration_s)


class SimClock:
    """A clock that a simulator owns: `advance` steps the world and moves the time.

    Args:
        advance: called with the seconds to pass; returns the new time in seconds. None makes a free-running test clock.
    """

    def __init__(self, advance: Callable[[float], float] | None = None, *, start_s: float = 0.0) -> None:
        self._advance = advance
        self._now_s = start_s
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Simulated seconds since the world began."""
        return self._now_s

    def attach(self, advance: Callable[[float], float]) -> None:
        """Let a world drive this clock; called once, when the first simulated device connects."""
        self._advance = advance

    def set_now_s(self, now_s: float) -> None:
        """Follow the world's time; it never goes back."""
        self._now_s = max(self._now_s, now_s)

    def sleep(self, duration_s: float) -> None:
        """Step the world by `duration_s`."""
        if duration_s <= 0.0:
            return
        with self._lock:
            end_s = self._now_s + duration_s
            self.set_now_s(self._advance(duration_s) if self._advance else end_s)


class PacedClock:
    """The time of a simulated world that never runs ahead of the wall (mode `mixed`).

    While somebody ticks, this is the world's time: a machine that is too slow makes time slow, and does not make set-points
    run away from a world that lags behind. When nobody ticks, time passes with the wall, so that deadlines end.
    """

    def __init__(self, advance: Callable[[float], float] | None = None) -> None:
        self._advance = advance
        self._lock = threading.Lock()
        self._now_s = time.monotonic()
        self._ticked_at_s = self._now_s - IDLE_S  # on the wall; until the first tick time passes with it
        self._ticking = 0
        self._ticks: deque[tuple[float, float]] = deque(maxlen=TICKS_KEPT)  # (wall, this clock) at the end of each

    def attach(self, advance: Callable[[float], float]) -> None:
        """Let this clock drive a world."""
        self._advance = advance

    def now_s(self) -> float:
        """Seconds; never goes back."""
        with self._lock:
            return self._present_s()

    def sleep(self, duration_s: float) -> None:
        """Step the world by `duration_s`, then wait for the wall to catch up."""
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
        """What this clock showed when `time.monotonic` showed `wall_s`; beyond its memory it went with the wall.

        What a wire between a cell and its simulated world carries ages in this time: a machine that is too slow makes
        its frames late, and its world as late as they are.
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


class ReplayClock:
    """Follows the stamps of a recording: `now_s` is the time of the newest record given out."""

    def __init__(self, *, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Recorded seconds."""
        return self._now_s

    def seek(self, stamp_s: float) -> None:
        """Move on to the stamp of the record that is given out now."""
        self._now_s = max(self._now_s, stamp_s)

    def sleep(self, duration_s: float) -> None:
        """Time passes at once: a recording has no present."""
        self._now_s += max(0.0, duration_s)


@dataclass(frozen=True, slots=True)
class Deadline:
    """A moment on a clock after which a call must have returned. One deadline owns a call and its retries."""

    at_s: float
    clock: Clock

    @classmethod
    def after(cls, clock: Clock, duration_s: float) -> Deadline:
        """The moment `duration_s` from now."""
        return cls(clock.now_s() + duration_s, clock)

    def remaining_s(self) -> float:
        """Seconds left, never negative."""
        return max(0.0, self.at_s - self.clock.now_s())

    def is_past(self) -> bool:
        """Has the moment passed?"""
        return self.clock.now_s() >= self.at_s
