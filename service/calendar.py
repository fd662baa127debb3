"""The time of day by which a service stores readings, follows alarms and begins rounds; by default the machine's.

A demonstration lets days pass in minutes by a calendar of its own; the cell's clock and all deadlines are not touched.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from hal.errors import InvalidRequest


class Calendar:
    """A time of day that is set forward, and goes on with the machine's clock in between.

    Args:
        now_s: where it begins, seconds since 1970.
    """

    def __init__(self, now_s: float) -> None:
        self._lock = threading.Lock()
        self._set_s, self._at_s = now_s, time.monotonic()

    def now_s(self) -> float:
        """Return the time, seconds since 1970."""
        with self._lock:
            return self._set_s + time.monotonic() - self._at_s

    def leap_to(self, then_s: float) -> None:
        """Go on from a later time.

        Raises:
            InvalidRequest: that time has passed.
        """
        with self._lock:
            now_s = self._set_s + time.monotonic() - self._at_s
            if then_s < now_s:
                what = f"the calendar is {now_s - then_s:.1f} s later than that already"
                raise InvalidRequest(what, hint="leap to a later time")
            self._set_s, self._at_s = then_s, time.monotonic()


_kept: ContextVar[Callable[[], float] | None] = ContextVar("calendar", default=None)


@contextmanager
def by_calendar(calendar: Calendar) -> Iterator[None]:
    """Let the services that are made here go by a calendar, for as long as they live."""
    before = _kept.set(calendar.now_s)
    try:
        yield
    finally:
        _kept.reset(before)


def calendar_clock() -> Callable[[], float] | None:
    """Return what tells the time by the calendar of this context; None for the machine's clock."""
    return _kept.get()
