"""Link: sends and receives bytes under a deadline.

Times here are `time.monotonic` seconds, because a link does not know the cell's clock. The errors defined here stay
inside `drivers`; `drivers.transport.device` converts them to the errors of `hal` with the device's name.
"""

from __future__ import annotations

import time
from typing import Protocol, runtime_checkable

FLOOD_BYTES = 1 << 20  # more than any buffer between the device and this process holds
NOT_A_BYTE = "no byte has arrived: check power and cable, and that the port leads to this device"
BYTES_WITHOUT_SENSE = (
    "bytes arrive, but none of them form a valid answer: the device, its address or, on a serial line, the baud rate is "
    "not the configured one; `panelwright doctor` finds the baud rate"
)


class WireError(Exception):
    """Base of all communication errors on a link."""


class LinkLost(WireError):
    """The port is gone: end of file, I/O error, or its path vanished or leads to another device."""


class RecordingEnded(LinkLost):
    """The recording that is replayed in place of the link has ended."""


class NoAnswer(WireError):
    """No valid answer arrived in time."""


class BadAnswer(WireError):
    """An answer arrived, but not to the request."""


class Refused(WireError):
    """The device answered with an error report.

    Attributes:
        code: number of the error in the device's manual.
        hint: what the user can do about it.
    """

    def __init__(self, what: str, *, code: int, hint: str = "look the code up in the device's manual") -> None:
        super().__init__(what)
        self.code = code
        self.hint = hint


class Link(Protocol):
    """Byte link in both directions. One thread reads; any thread may write."""

    @property
    def name(self) -> str:
        """Return the name shown to people: `serial /dev/ttyUSB0, 115200 baud`."""
        ...

    @property
    def byte_s(self) -> float:
        """Return the seconds one byte takes on the line; 0 where data arrive in whole messages."""
        ...

    def read(self, until_s: float) -> bytes:
        """Return the bytes that have arrived: at least one, or `b""` when `until_s` passes without any.

        Raises:
            LinkLost: the port is gone.
        """
        ...

    def write(self, data: bytes, until_s: float) -> None:
        """Send all of `data`.

        Raises:
            NoAnswer: the data could not be sent before `until_s`.
            LinkLost: the port is gone.
        """
        ...

    def is_present(self) -> bool:
        """Return whether the port's path still leads to the open port; called after silence."""
        ...

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        ...


class CountingLink:
    """Base of links that count the bytes received: this distinguishes a dead line from bytes that no parser accepts."""

    received = 0


@runtime_checkable
class Cancellable(Protocol):
    """Link whose reads another thread can end, so that `close` need not wait while a set-up waits seconds for answers."""

    def cancel(self) -> None:
        """Make a waiting read and all later ones raise `LinkLost`."""
        ...


def now_s() -> float:
    """Return the time on the links' clock (`time.monotonic`), in seconds."""
    return time.monotonic()


def drain(link: Link) -> bytes:
    """Read and return everything already received, up to a limit; bytes from before a request cannot be its answer."""
    late = b""
    while len(late) < FLOOD_BYTES and (chunk := link.read(0.0)):
        late += chunk
    return late


def drain_until_quiet(link: Link, *, quiet_s: float, until_s: float) -> int:
    """Discard bytes until none has arrived for `quiet_s`, or until `until_s`; return how many were discarded."""
    dropped = 0
    while now_s() < until_s:
        chunk = link.read(min(now_s() + quiet_s, until_s))
        if not chunk:
            break
        dropped += len(chunk)
    return dropped
