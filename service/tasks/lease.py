"""The lease, which gives one client the right to move the arm; it has an epoch that rises with each grant, and it expires.

A command may have a number, which must rise while the lease is held, and a time until which it may begin.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hal.clock import Clock, WallClock
from hal.errors import LeaseError
from service.errors import Expired, StaleEpoch, StaleSequence, TooDistant
from service.tasks.sub_leases import SubLease, SubLeases

HORIZON_S = 10.0  # a command that may begin later than this was not meant for now


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A lease as it was granted to its holder; only the holder knows `token`."""

    holder: str
    epoch: int
    token: str
    ttl_s: float
    remaining_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """What comes with a command.

    Attributes:
        token: of the lease; None from a client without one.
        sequence: must be greater than that of every earlier command under the same lease; None for a client that does not
            count.
        until_s: the command begins before this time of the service's monotonic clock, or not at all; None for no limit.
    """

    token: str | None = None
    sequence: int | None = None
    until_s: float | None = None


class LeaseDesk:
    """Grants, renews, checks and ends the lease, on the monotonic clock.

    Args:
        ttl_s: the lease lapses after this time without a heartbeat.
        on_loss: called with a reason when a holder loses the lease by lapse or take-over, after the holder's tasks were
            stopped.
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
        self.subs = SubLeases(self._clock)
        self._sequence: int | None = None
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

    def take_over(self, holder: str, *, reason: str = "") -> Grant:
        """Take the lease from its holder; tasks of that holder, and of clients without a lease, are stopped."""
        self.expire()
        with self._lock:
            before, moving = self._holder, self._others(holder)
            grant = self._grant(holder, "lease-taken-over", **({"reason": reason} if reason else {}))
            lent = self.subs.all()
        if before is not None or moving is not None:
            why = f"{holder} took the lease over" + (f" from {before}" if before is not None else "")
            self._lose(lent, f"{why}: {reason}" if reason else why)
        return grant

    def admit(self, command: Command) -> str | None:
        """Check a command and count it; returns the holder's name, or None when nobody holds the lease.

        Raises:
            LeaseError, StaleEpoch: as for `check`.
            StaleSequence: this or a later command came before.
            Expired, TooDistant: its time has passed, or is further away than a command may wait.
        """
        with self._lock:
            holder = self.check(command.token)
            self.check_in_time(command)
            if command.sequence is None and self._sequence is not None:
                raise StaleSequence(
                    "the commands of this lease are numbered, and this one has no number",
                    hint="send Lease-Sequence with every command",
                    newest=self._sequence,
                )
            if command.sequence is not None and holder is not None:
                if self._sequence is not None and command.sequence <= self._sequence:
                    raise StaleSequence(
                        f"command {command.sequence} came after command {self._sequence}, so it is old or a repeat",
                        hint="number the commands of a lease upwards; to repeat one, use an Idempotency-Key",
                        newest=self._sequence,
                    )
                self._sequence = command.sequence
            return holder

    def check_in_time(self, command: Command) -> None:
        """Raise `Expired` or `TooDistant` unless the command may begin now."""
        if command.until_s is None:
            return
        left_s = command.until_s - self._clock.now_s()
        if left_s < 0.0:
            raise Expired(
                f"EXPIRED: the command was to begin {-left_s:.3f} s ago at the latest",
                hint="look at the cell, then command again",
                late_s=round(-left_s, 3),
            )
        if left_s > HORIZON_S:
            raise TooDistant(
                f"TOO_DISTANT: the command may begin in {left_s:.3f} s; {HORIZON_S:g} s are allowed",
                hint="Command-Until is `clock_s` of GET /v1/lease and at most 10 s; did the service restart?",
                early_s=round(left_s - HORIZON_S, 3),
            )

    def lend(self, *, is_own: bool) -> SubLease:
        """Return a sub-lease for one task; `is_own`: a client without a lease must keep it."""
        with self._lock:
            return self.subs.lend(self._epoch, is_own=is_own)

    def clock_s(self) -> float:
        """Return the time on the monotonic clock, by which commands say how long they may wait."""
        return self._clock.now_s()

    def newest_sequence(self) -> int | None:
        """Return the number of the newest numbered command of this lease; None without one."""
        return self._sequence

    def soonest_s(self) -> float:
        """Return the seconds until the lease or a sub-lease may end; infinite when none can."""
        with self._lock:
            ends_s = [self._ends_s] if self._holder is not None else []
        own_s = self.subs.soonest_s()
        ends_s += [own_s] if own_s is not None else []
        return max(0.0, min(ends_s) - self._clock.now_s()) if ends_s else float("inf")

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
        """End the lease if its heartbeat is overdue, and sub-leases that nobody keeps; called before every decision."""
        self.subs.expire()
        with self._lock:
            if self._holder is None or self._clock.now_s() < self._ends_s:
                return
            lost, self._holder, self._token = self._holder, None, ""
            self._report("lease-lapsed", {"holder": lost, "epoch": self._epoch})
            lent = self.subs.all()
        self._lose(lent, f"the lease of {lost} lapsed: no heartbeat for {self.ttl_s:g} s")

    def _lose(self, lent: list[SubLease], reason: str) -> None:
        """Stop the tasks that had these sub-leases; those of a new holder have others and go on."""
        self.subs.lose(lent, reason)
        self._on_loss(reason)

    def _grant(self, holder: str, kind: str, **told: str) -> Grant:
        self._commit(kind, {"holder": holder, "before": self._holder, "epoch": self._epoch + 1, **told})
        self._epoch += 1
        self._sequence = None
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
