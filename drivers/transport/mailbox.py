"""Mailbox: hands the newest value of a device from its owner thread to any number of readers."""

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
RING = 512  # samples kept for readers that want every sample: 1 s at 500 Hz
IMAGES_RING = 8  # 512 colour images of 5 megapixels would be 8 GB


class Mailbox(Generic[T]):
    """Latest value plus a bounded ring; a slow reader loses old samples and can count them, but never blocks the writer.

    No thread waits for a lock that another thread holds: if the owner thread were descheduled in the middle of `publish`,
    readers would miss their deadline. Single operations of a deque are atomic, and each waiting reader has a lock of its
    own (its bell), which the thread that brings news releases once.
    """

    def __init__(self, *, ring: int = RING) -> None:
        self._ring: deque[Stamped[T]] = deque(maxlen=ring)
        self._error: tuple[CellError | None, float] = (None, 0.0)
        self._bells: deque[threading.Lock] = deque()
        self._published = 0

    @property
    def published(self) -> int:
        """Return the number of samples published so far."""
        return self._published

    def publish(self, sample: Stamped[T]) -> None:
        """Publish the newest sample and clear any error."""
        self._error = (None, 0.0)
        self._ring.append(sample)
        self._published += 1
        self._wake_readers()

    def fail(self, error: CellError) -> None:
        """Make readers raise `error` until the next sample arrives."""
        self._error = (error, now_s())
        self._wake_readers()

    def clear(self) -> None:
        """Discard all samples, because they no longer describe the device."""
        self._ring.clear()

    def peek(self) -> Stamped[T] | None:
        """Return the newest sample, or None; never waits."""
        try:
            return self._ring[-1]
        except IndexError:
            return None

    def error(self) -> CellError | None:
        """Return the error that readers would raise now, if any."""
        return self._error[0]

    def wait(self, *, oldest_host_s: float, until_s: float, errors_since_s: float = -math.inf) -> Stamped[T] | None:
        """Return the newest sample valid at or after `oldest_host_s`, or None if there is none by `until_s`.

        A device that has gone silent may send again before `until_s`, so its silence is reported only then.

        Args:
            errors_since_s: on the links' clock; errors older than this do not end the wait for a newer sample.

        Raises:
            CellError: what the owner thread passed to `fail`.
        """
        while True:
            bell = threading.Lock()
            bell.acquire()
            self._bells.append(bell)  # before the first check, so that no news is missed between check and wait
            try:
                left_s = until_s - now_s()
                found = self._look(oldest_host_s, errors_since_s, is_last=left_s <= 0.0)
                if found is not None or left_s <= 0.0:
                    return found
                bell.acquire(timeout=left_s)
            finally:
                with suppress(ValueError):  # already rung, and so removed
                    self._bells.remove(bell)

    def _look(self, oldest_host_s: float, errors_since_s: float, *, is_last: bool) -> Stamped[T] | None:
        error, error_s = self._error
        if error_s < errors_since_s:
            error = None
        if error is not None and not isinstance(error, DeviceTimeout):
            raise copy(error)  # each reader raises its own copy, so that tracebacks do not accumulate
        newest = self.peek()
        if newest is not None and newest.host_time_s >= oldest_host_s:
            return newest
        if error is not None and is_last:
            raise copy(error)
        return None

    def _wake_readers(self) -> None:
        for _ in range(len(self._bells)):  # a reader that waits again meanwhile has seen the news
            try:
                self._bells.popleft().release()
            except IndexError:
                return  # the readers are gone, or another thread rang the rest

    def since(self, sequence: int) -> tuple[list[Stamped[T]], int]:
        """Return the samples after `sequence` still in the ring, oldest first, and how many were lost to a slow reader."""
        fresh = [sample for sample in list(self._ring) if sample.sequence > sequence]
        lost = fresh[0].sequence - sequence - 1 if fresh else 0
        return fresh, max(0, lost)
