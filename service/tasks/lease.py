"""The lease, which gives one client the right to move the arm; it has an epoch that rises with each grant, and it expires."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hal.clock import Clock, WallClock
from hal.errors import LeaseError
from service.errors import StaleEpoch


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A lease as it was granted to its holder; only the holder knows `token`."""

    holder: str
    epoch: int
    token: str
    ttl_s: float
    remaining_s: float


class LeaseDesk:
    """Grants, renews, checks and ends the lease, on the monotonic clock.

    Args:
        ttl_s: the lease lapses after this time without a heartbeat.
        on_loss: called with a reason when a holder loses the lease by lapse or take-over; stops the holder's tasks.
        others: returns a sentence about a motion task (running or queued) that this holder did not start, or None.
        report: called for each lapse.
        commit: called before each grant, take-over and release, which do not happen when it raises.
    """

    def __init__(
        self,
        *,
        ttl_s: float,
        clock: Clock | None = None,
        on_loss: Callable[[str], None] = lambda _reason: None,
        others: Callable[[str], str | None] = lambda _holder: None,
        report: Callable[[str, dict[str, Any]], None] = lambda _kind, _data: None,
        commit: Callable[[str, dict[str, Any]], None] = lambda _kind, _data: None,
    ) -> None:
        self.ttl_s = ttl_s
        self._clock = clock or WallClock()
        self._on_loss = on_loss
        self._others = others
        self._report = report
        self._commit = commit
        self._lock = threading.RLock()
        self._epoch = 0
        self._holder: str | None = None
        self._token = ""
        self._ends_s = 0.0

    def acquire(self, holder: str) -> Grant:
        """Take the free lease.

        Raises:
            LeaseError: another client holds it (`details["holder"]`), or a task of another client moves without a lease.
        """
        self.expire()
        with self._lock:
            if self._holder is not None:
                raise LeaseError(
                    f"{self._holder} holds the cell",
                    hint="wait for its release, or take over on purpose: POST /v1/lease/take-over",
                    holder=self._holder,
                    epoch=self._epoch,
                )
            if (moving := self._others(holder)) is not None:
                raise LeaseError(
                    f"nobody holds the cell, but {moving}",
                    hint="wait for its end, cancel it, or take over on purpose: POST /v1/lease/take-over",
                    epoch=self._epoch,
                )
            return self._grant(holder, "lease-acquired")

    def take_over(self, holder: str) -> Grant:
        """Take the lease from its holder; tasks of that holder, and of clients without a lease, are stopped."""
        self.expire()
        with self._lock:
            before, moving = self._holder, self._others(holder)
            grant = self._grant(holder, "lease-taken-over")
        if before is not None or moving is not None:
            self._on_loss(f"{holder} took the lease over" + (f" from {before}" if before is not None else ""))
        return grant

    def heartbeat(self, token: str) -> Grant:
        """Renew the lease.

        Raises:
            StaleEpoch: another client holds the lease now, or nobody does.
        """
        self.expire()
        with self._lock:
            self.check(token)
            self._ends_s = self._clock.now_s() + self.ttl_s
            return self._shown()

    def release(self, token: str) -> None:
        """Give the lease back.

        Raises:
            StaleEpoch: the caller does not hold the lease any more.
        """
        self.expire()
        with self._lock:
            self.check(token)
            self._commit("lease-released", {"holder": self._holder, "epoch": self._epoch})
            self._holder, self._token = None, ""

    def check(self, token: str | None) -> str | None:
        """Check that the bearer of `token` may move; returns the holder's name, or None when nobody holds the lease.

        Raises:
            LeaseError: another client holds the lease.
            StaleEpoch: the token belongs to an earlier epoch.
        """
        self.expire()
        with self._lock:
            is_holders = self._holder is not None and secrets.compare_digest(
                (token or "").encode(), self._token.encode()
            )
            if token is not None and not is_holders:
                raise StaleEpoch("this lease has ended", hint="acquire it again: POST /v1/lease", epoch=self._epoch)
            if token is None and self._holder is not None:
                raise LeaseError(
                    f"{self._holder} holds the cell",
                    hint="send its token as Lease-Token, wait, or take over on purpose",
                    holder=self._holder,
                    epoch=self._epoch,
                )
            return self._holder

    def holder(self) -> tuple[str | None, int, float]:
        """Return the holder (or None), the epoch and the seconds that are left."""
        self.expire()
        with self._lock:
            left_s = max(0.0, self._ends_s - self._clock.now_s()) if self._holder is not None else 0.0
            return self._holder, self._epoch, left_s

    def expire(self) -> None:
        """End the lease if its heartbeat is overdue; called before every decision and by a timer."""
        with self._lock:
            if self._holder is None or self._clock.now_s() < self._ends_s:
                return
            lost, self._holder, self._token = self._holder, None, ""
            self._report("lease-lapsed", {"holder": lost, "epoch": self._epoch})
        self._on_loss(f"the lease of {lost} lapsed: no heartbeat for {self.ttl_s:g} s")

    def _grant(self, holder: str, kind: str) -> Grant:
        self._commit(kind, {"holder": holder, "before": self._holder, "epoch": self._epoch + 1})
        self._epoch += 1
        self._holder = holder
        self._token = f"{self._epoch}.{secrets.token_urlsafe(16)}"
        self._ends_s = self._clock.now_s() + self.ttl_s
        return self._shown()

    def _shown(self) -> Grant:
        assert self._holder is not None  # noqa: S101 - narrowing: only called while there is a holder
        return Grant(
            holder=self._holder,
            epoch=self._epoch,
            token=self._token,
            ttl_s=self.ttl_s,
            remaining_s=max(0.0, self._ends_s - self._clock.now_s()),
        )
