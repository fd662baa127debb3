"""The newest value of a device, handed from its owner thread to any number of readers."""

from __future__ import annotations

import math
import threading
from collections import deque
from contextlib import suppress
from copy import copy
from typing import Generic, TypeVar

from drivers.transport.link import now_s
from hal.errors import CellError, DeviceTimeout
from hal.readings import Stamped

T = TypeVar("T")
RING = 512  # samples kept for readers that want every one: 1 s at 500 Hz


class Mailbox(Generic[T]):
    """Latest value plus a bounded ring; a slow reader loses old samples and can count them, never blocks the writer.

    Nobody holds a lock that another thread waits for: an owner thread put off the processor in the middle of `publish`
    would keep readers beyond their deadline. Single operations of a deque are atomic, and each waiting reader has a
    bell of its own, a lock that whoever brings news opens once.
    """

    def __init__(self, *, ring: int = RING) -> None:
        self._ring: deque[Stamped[T]] = deque(maxlen=ring)
        self._error: tuple[CellError | None, float] = (None, 0.0)
        self._bells: deque[threading.Lock] = deque()
        self._published = 0

    @property
    def published(self) -> int:
        """Samples published so far."""
        return self._published

    def publish(self, sample: Stamped[T]) -> None:
        """Put the newest sample; ends an error."""
        self._error = (None, 0.0)
        self._ring.append(sample)
        self._published += 1
        self._wake_readers()

    def fail(self, error: CellError) -> None:
        """Let readers raise `error` until the next sample comes."""
        self._error = (error, now_s())
        self._wake_readers()

    def clear(self) -> None:
        """Forget all samples: what was read before no longer describes the device."""
        self._ring.clear()

    def peek(self) -> Stamped[T] | None:
        """The newest sample, or None; never waits."""
        try:
            return self._ring[-1]
        except IndexError:
            return None

    def error(self) -> CellError | None:
        """What readers would raise now."""
        return self._error[0]

    def wait(self, *, oldest_host_s: float, until_s: float, errors_since_s: float = -math.inf) -> Stamped[T] | None:
        """The newest sample that was valid at or after `oldest_host_s`; None when none has come at `until_s`.

        A device that has fallen silent may speak before `until_s`: only then its silence is the answer.

        Args:
            errors_since_s: on the links' clock; an older error is no answer to a reader who wants a newer sample.

        Raises:
            CellError: what the owner thread has put with `fail`.
        """
        while True:
            bell = threading.Lock()
            bell.acquire()
            self._bells.append(bell)  # before the look, so that no news falls between look and wait
            try:
                left_s = until_s - now_s()
                found = self._look(oldest_host_s, errors_since_s, is_last=left_s <= 0.0)
                if found is not None or left_s <= 0.0:
                    return found
                bell.acquire(timeout=left_s)
            finally:
                with suppress(ValueError):  # rung, and so taken out, meanwhile
                    self._bells.remove(bell)

    def _look(self, oldest_host_s: float, errors_since_s: float, *, is_last: bool) -> Stamped[T] | None:
        error, error_s = self._error
        if error_s < errors_since_s:
            error = None
        if error is not None and not isinstance(error, DeviceTimeout):
            raise copy(error)  # each reader gets its own, so that tracebacks do not pile up
        newest = self.peek()
        if newest is not None and newest.host_time_s >= oldest_host_s:
            return newest
        if error is not None and is_last:
            raise copy(error)
        return None

    def _wake_readers(self) -> None:
        for _ in range(len(self._bells)):  # a reader that waits again meanwhile has looked after the news
            try:
                self._bells.popleft().release()
            except IndexError:
                return  # readers have gone, or another thread has news too

    def since(self, sequence: int) -> tuple[list[Stamped[T]], int]:
        """Samples after `sequence` still in the ring, oldest first, and how many were lost to a slow reader."""
        fresh = [sample for sample in list(self._ring) if sample.sequence > sequence]
        lost = fresh[0].sequence - sequence - 1 if fresh else 0
        return fresh, max(0, lost)
