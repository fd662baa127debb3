"""The newest value of a device, handed from its owner thread to any number of readers."""

from __future__ import annotations

import math
import threading
from collections import deque
from copy import copy
from typing import Generic, TypeVar

from drivers.transport.link import now_s
from hal.errors import CellError, DeviceTimeout
from hal.readings import Stamped

T = TypeVar("T")
RING = 512  # samples kept for readers that want every one: 1 s at 500 Hz


class Mailbox(Generic[T]):
    """Latest value plus a bounded ring; a slow reader loses old samples and can count them, never blocks the writer."""

    def __init__(self, *, ring: int = RING) -> None:
        self._changed = threading.Condition()
        self._ring: deque[Stamped[T]] = deque(maxlen=ring)
        self._error: CellError | None = None
        self._error_s = 0.0
        self._published = 0

    @property
    def published(self) -> int:
        """Samples published so far."""
        return self._published

    def publish(self, sample: Stamped[T]) -> None:
        """Put the newest sample; ends an error."""
        with self._changed:
            self._ring.append(sample)
            self._published += 1
            self._error = None
            self._changed.notify_all()

    def fail(self, error: CellError) -> None:
        """Let readers raise `error` until the next sample comes."""
        with self._changed:
            self._error, self._error_s = error, now_s()
            self._changed.notify_all()

    def clear(self) -> None:
        """Forget all samples: what was read before no longer describes the device."""
        with self._changed:
            self._ring.clear()

    def peek(self) -> Stamped[T] | None:
        """The newest sample, or None; never waits."""
        ring = self._ring
        return ring[-1] if ring else None

    def error(self) -> CellError | None:
        """What readers would raise now."""
        return self._error

    def wait(self, *, oldest_host_s: float, until_s: float, errors_since_s: float = -math.inf) -> Stamped[T] | None:
        """The newest sample that was valid at or after `oldest_host_s`; None when none has come at `until_s`.

        A device that has fallen silent may speak before `until_s`: only then its silence is the answer.

        Args:
            errors_since_s: on the links' clock; an older error is no answer to a reader who wants a newer sample.

        Raises:
            CellError: what the owner thread has put with `fail`.
        """
        with self._changed:
            while True:
                error = self._error if self._error_s >= errors_since_s else None
                if error is not None and not isinstance(error, DeviceTimeout):
                    raise copy(error)  # each reader gets its own, so that tracebacks do not pile up
                newest = self.peek()
                if newest is not None and newest.host_time_s >= oldest_host_s:
                    return newest
                left_s = until_s - now_s()
                if left_s > 0.0:
                    self._changed.wait(left_s)
                    continue
                if error is not None:
                    raise copy(error)
                return None

    def since(self, sequence: int) -> tuple[list[Stamped[T]], int]:
        """Samples after `sequence` still in the ring, oldest first, and how many were lost to a slow reader."""
        with self._changed:
            fresh = [sample for sample in self._ring if sample.sequence > sequence]
        lost = fresh[0].sequence - sequence - 1 if fresh else 0
        return fresh, max(0, lost)
