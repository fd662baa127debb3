"""Sub-leases: the right of one task to move, lent from the lease or, while nobody holds it, from the free cell.

A task of a client without a lease has a sub-lease of its own that somebody must keep: it ends when the connection of the
waiting client breaks, and some seconds after the last client stopped following the task.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

from hal.clock import Clock
from service.errors import NotPossibleNow, StaleEpoch

OWN_WINDOW_S = 10.0  # a browser reconnects its event stream after 3 s


@dataclass(slots=True, kw_only=True, eq=False)
class SubLease:
    """The right of one task to move.

    Attributes:
        name: epoch of the lease and a rising number, such as `3.17`.
        is_own: whether a client must keep it, because it was lent without a lease.
        lost: why it has ended; None while it is valid.
        ends_s: when it ends unless a client keeps it; only of an own one.
        keepers: number of connections that keep it at present.
        is_of_console: whether the console began its task.
        on_loss: called once with the reason when it is lost; cancels the task.
        is_over: whether its task has ended.
    """

    name: str
    is_own: bool
    ends_s: float
    lost: str | None = None
    keepers: int = 0
    is_of_console: bool = False
    on_loss: Callable[[str], object] = lambda _reason: None
    is_over: Callable[[], bool] = lambda: False

    def check(self) -> None:
        """Raise `StaleEpoch` when the sub-lease was lost, so that its task moves no more."""
        if self.lost is not None:
            raise StaleEpoch(f"the task may not move any more: {self.lost}", hint="ask again", sub_lease=self.name)


class SubLeases:
    """Lends, keeps and ends sub-leases; several threads may call it.

    Args:
        clock: a monotonic clock.
        window_s: an own sub-lease ends this long after the last client stopped following its task.
    """

    def __init__(self, clock: Clock, *, window_s: float = OWN_WINDOW_S) -> None:
        self._clock = clock
        self.window_s = window_s
        self._lock = threading.Lock()
        self._lent: list[SubLease] = []
        self._number = 0

    def lend(self, epoch: int, *, is_own: bool) -> SubLease:
        """Return a new sub-lease."""
        with self._lock:
            self._number += 1
            sub = SubLease(name=f"{epoch}.{self._number}", is_own=is_own, ends_s=self._clock.now_s() + self.window_s)
            self._lent = [one for one in self._lent if not one.is_over()] + [sub]
            return sub

    def give_back(self, sub: SubLease) -> None:
        """End a sub-lease with its task."""
        with self._lock, suppress(ValueError):
            self._lent.remove(sub)

    @contextmanager
    def kept(self, sub: SubLease | None) -> Iterator[None]:
        """Keep a sub-lease while a client waits for its task, and for the window after that."""
        if sub is None:
            yield
            return
        with self._lock:
            sub.keepers += 1
        try:
            yield
        finally:
            with self._lock:
                sub.keepers -= 1
                sub.ends_s = self._clock.now_s() + self.window_s

    @contextmanager
    def kept_of_console(self) -> Iterator[None]:
        """Keep the sub-leases of the tasks that the console began, while it is started again."""
        with ExitStack() as kept:
            for sub in self.all():
                if sub.is_of_console:
                    kept.enter_context(self.kept(sub))
            yield

    def lose(self, subs: list[SubLease], reason: str) -> None:
        """End these sub-leases and cancel their tasks."""
        with self._lock:
            lost = [sub for sub in subs if sub.lost is None]
            self._lent = [sub for sub in self._lent if sub not in subs]
        for sub in lost:
            with suppress(NotPossibleNow):  # its task has ended meanwhile
                sub.on_loss(reason)
            sub.lost = reason  # after the cancellation, so that the task ends as cancelled and not as failed

    def all(self) -> list[SubLease]:
        """Return all sub-leases that are lent."""
        with self._lock:
            return list(self._lent)

    def expire(self) -> None:
        """End the own sub-leases that no client has kept for the whole window."""
        now_s = self._clock.now_s()
        with self._lock:
            late = [sub for sub in self._lent if sub.is_own and not sub.keepers and now_s >= sub.ends_s]
        if late:
            self.lose(
                late, f"its client is gone: nobody followed the task for {self.window_s:g} s, and it holds no lease"
            )

    def soonest_s(self) -> float | None:
        """Return when the next own sub-lease ends; None without one."""
        with self._lock:
            return min((sub.ends_s for sub in self._lent if sub.is_own and not sub.keepers), default=None)
