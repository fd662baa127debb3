"""A link carries bytes under a deadline.

Times here are `time.monotonic` seconds: a wire does not know the cell's clock. These errors stay inside `drivers`;
`drivers.transport.device` turns them into the errors of `hal` with the device's name.
"""

from __future__ import annotations

import time
from typing import Protocol, runtime_checkable

FLOOD_BYTES = 1 << 20  # more than any buffer between a device and us holds


class WireError(Exception):
    """Something went wrong on a wire."""


class LinkLost(WireError):
    """The port has gone: end of file, I/O error, its name vanished or names another device."""


class RecordingEnded(LinkLost):
    """A recording that is read in the place of a wire holds no more."""


class NoAnswer(WireError):
    """Nothing valid came in time."""


class BadAnswer(WireError):
    """The far side answered, but not what was asked."""


class Refused(WireError):
    """The device answered with an error report.

    Attributes:
        code: as the device's manual numbers it.
        hint: what to do about it.
    """

    def __init__(self, what: str, *, code: int, hint: str = "look the code up in the device's manual") -> None:
        super().__init__(what)
        self.code = code
        self.hint = hint


class Link(Protocol):
    """Bytes both ways. One thread reads; any thread may write."""

    @property
    def name(self) -> str:
        """What a person would call it: `serial /dev/ttyUSB0, 115200 baud`."""
        ...

    @property
    def byte_s(self) -> float:
        """Seconds a byte takes on the line; 0 where bytes arrive at once."""
        ...

    def read(self, until_s: float) -> bytes:
        """What has arrived: at least one byte, or `b""` when `until_s` passes without one.

        Raises:
            LinkLost: the port has gone.
        """
        ...

    def write(self, data: bytes, until_s: float) -> None:
        """Send all of `data`.

        Raises:
            NoAnswer: the far side did not take it before `until_s`.
            LinkLost: the port has gone.
        """
        ...

    def is_present(self) -> bool:
        """Does the port's name still lead to the port that is open? Asked after silence."""
        ...

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        ...


@runtime_checkable
class Cancellable(Protocol):
    """A link whose reads another thread can end: a set-up may wait for answers for seconds, `close` must not."""

    def cancel(self) -> None:
        """End a read that waits, and all later ones, with `LinkLost`."""
        ...


def now_s() -> float:
    """The time that links count in."""
    return time.monotonic()


def drain(link: Link) -> bytes:
    """Everything that lies ready; whatever came before a request cannot be its answer. A flood does not hold it up."""
    late = b""
    while len(late) < FLOOD_BYTES and (chunk := link.read(0.0)):
        late += chunk
    return late


def drain_until_quiet(link: Link, *, quiet_s: float, until_s: float) -> int:
    """Throw bytes away until none has come for `quiet_s`; returns how many. Ends at `until_s` in any case."""
    dropped = 0
    while now_s() < until_s:
        chunk = link.read(min(now_s() + quiet_s, until_s))
        if not chunk:
            break
        dropped += len(chunk)
    return dropped
