"""Device that streams without being asked: its owner thread reads, parses and publishes, and reopens after silence."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeVar

from drivers.transport.capture import inside
from drivers.transport.device import CONNECT_S, SLICE_S, PortDevice
from drivers.transport.link import CountingLink, Link, LinkLost, NoAnswer, now_s
from drivers.transport.port import Port
from hal.registry import Context

T = TypeVar("T")


class StreamDevice(PortDevice[T]):
    """Device that streams without being asked; the subclass starts the stream and parses its bytes.

    Args:
        open_link: opens the port.
        silence_s: after this long without a sample, but not before the last one exceeds `max_age_s`, the link is reopened
            and set up again.
        realtime_priority: priority of the owner thread (see `Port`).
    """

    def __init__(
        self,
        context: Context,
        *,
        open_link: Callable[[], Link],
        link_name: str,
        max_age_s: float,
        silence_s: float = 0.5,
        realtime_priority: int = 0,
    ) -> None:
        super().__init__(context, max_age_s=max_age_s)
        self._link_name = link_name
        self._silence_s = self.patience * silence_s
        self._heard_s = now_s()
        self.bytes_in = 0
        self._line: CountingLink | None = None
        self._heard_before = 0
        self.byte_s = 0.0
        self.port = Port(context.name, open_link=open_link, tenant=self, realtime_priority=realtime_priority)

    @abstractmethod
    def start(self, link: Link) -> None:
        """Stop any running stream, flush, identify, configure and start, whatever state the device was left in."""

    @abstractmethod
    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Parse bytes and `publish` complete samples; bad data is no error, but `WireError` may be raised to restart."""

    def join(self, timeout_s: float = CONNECT_S) -> None:
        """Start the owner thread and wait for the first sample.

        Raises:
            DeviceUnavailable: no sample arrived.
        """
        self.port.start()
        self.await_first(timeout_s)

    def set_up(self, link: Link) -> None:
        """Start the stream (owner thread)."""
        self._heard_before = self.heard_bytes() or 0
        self._line = inside(link, CountingLink)
        self.byte_s = link.byte_s
        self.start(link)
        self._heard_s = now_s()

    def keep_going(self, link: Link) -> float:  # noqa: ARG002  # for subclasses that need it
        """Send what the device must receive regularly; return how long the next read may wait, in seconds."""
        return SLICE_S

    def serve(self, link: Link) -> None:
        """Read one chunk (owner thread)."""
        self.take_in(link, now_s() + self.keep_going(link))
        silent_s = now_s() - self._heard_s
        if silent_s > 3 * SLICE_S and not link.is_present():
            raise LinkLost(f"{link.name}: its path no longer exists or now leads to another port")
        if silent_s > max(self._silence_s, self.max_age_s):
            raise NoAnswer(f"no valid data for {silent_s:.2f} s; {self.wire_counts()}")

    def take_in(self, link: Link, until_s: float) -> None:
        """Wait for a chunk until `until_s` and parse it (owner thread)."""
        chunk = link.read(until_s)
        if not chunk:
            return
        arrived_s = now_s()
        self.bytes_in += len(chunk)
        before = self.mailbox.published
        self.receive(chunk, arrived_s)
        if self.mailbox.published > before:
            self._heard_s = arrived_s

    def link_name(self) -> str:
        """Return the link's name: port and baud rate, or network address."""
        return self._link_name

    def wire_counts(self) -> str:
        """Return the counters as text; bytes without frames mean a wrong baud rate or a wrong device."""
        heard = self.heard_bytes()
        heard = self.bytes_in if heard is None else heard
        return f"{heard} bytes, {self.mailbox.published} samples, {self.errors} errors"

    def heard_bytes(self) -> int | None:
        """Return the bytes counted by the link since the device was connected; None for a replay."""
        line = self._line
        return None if line is None else self._heard_before + line.received
