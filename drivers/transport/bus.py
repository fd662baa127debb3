"""Bus of devices that answer requests: one lock, one owner thread, and a separate health state per station."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from drivers.transport.capture import inside
from drivers.transport.device import CONNECT_S, WireDevice
from drivers.transport.link import BadAnswer, CountingLink, Link, LinkLost, NoAnswer, WireError, now_s
from drivers.transport.port import Port
from drivers.transport.timebase import ExchangeTime
from hal.clock import Deadline
from hal.errors import CellError
from hal.registry import Context

C = TypeVar("C")
C_contra = TypeVar("C_contra", contravariant=True)
R = TypeVar("R")
T = TypeVar("T")
IDLE_S = 0.02
SET_UP_AGAIN_AFTER = 5  # polls without an answer: the device may have been power-cycled
YIELD_S, LONGEST_YIELD_S = 0.0005, 0.02  # callers get the bus between two polls, and polls get it between many calls
SLOWEST_POLL_S = 0.5  # an unresponsive station may cost the others at most one time-out per this interval


class Station(Protocol[C_contra]):
    """Device on a bus, as seen by the owner thread."""

    @property
    def period_s(self) -> float:
        """Return the time between two polls, in seconds."""
        ...

    def set_up(self, client: C_contra) -> None:
        """Identify and configure the device; called again after each loss of the bus."""
        ...

    def poll(self, client: C_contra) -> None:
        """Request the newest values and publish them."""
        ...

    def fail(self, error: Exception) -> None:
        """Record that a poll or set-up failed, or that the bus was lost."""
        ...


class _Slot(Generic[C]):
    """Station together with its polling schedule."""

    def __init__(self, station: Station[C]) -> None:
        self.station = station
        self.needs_set_up = True
        self.failures = 0
        self.due_s = 0.0


class Bus(Generic[C]):
    """Polls its stations in turn and lets callers send requests between polls.

    Args:
        client: creates the protocol client on a newly opened link.
    """

    def __init__(self, name: str, *, open_link: Callable[[], Link], client: Callable[[Link], C]) -> None:
        self.name = name
        self._make_client = client
        self._client: C | None = None
        self._slots: list[_Slot[C]] = []
        self._lock = threading.Lock()
        self._callers: deque[None] = deque()  # one entry per caller that is waiting for the bus
        self._open_link = open_link
        self._rest = threading.Event()  # never set: waiting on it is a sleep
        self._port: Port[Link] | None = None
        self._members = threading.Lock()
        self._line: CountingLink | None = None

    def attach(self, station: Station[C]) -> None:
        """Add a station; the first one starts the owner thread."""
        with self._members:
            self._slots = [*self._slots, _Slot(station)]
            if self._port is None:
                self._port = Port(self.name, open_link=self._open_link, tenant=self)
                self._port.start()

    def detach(self, station: Station[C]) -> None:
        """Remove a station; the last one ends the thread and closes the port, which a later `attach` opens again."""
        with self._members:
            self._slots = [slot for slot in self._slots if slot.station is not station]
            port = self._port
            if self._slots or port is None:
                return
            self._port = None
        port.close()

    @property
    def is_up(self) -> bool:
        """Return whether the port is open."""
        return self._client is not None

    @property
    def reconnects(self) -> int:
        """Return how many times the port was reopened."""
        return self._port.reconnects if self._port is not None else 0

    @property
    def heard_bytes(self) -> int | None:
        """Return the number of bytes received on the open port, or None where the link does not count them."""
        line = self._line
        return None if line is None else line.received

    def call(self, work: Callable[[C, float], R], until_s: float) -> R:
        """Run `work(client, until_s)` with exclusive use of the bus, in the caller's thread.

        Raises:
            NoAnswer: the bus was busy until `until_s`. LinkLost: the bus is down. Also whatever `work` raises.
        """
        self._callers.append(None)
        try:
            is_ours = self._lock.acquire(timeout=max(0.0, until_s - now_s()))
        finally:
            self._callers.pop()
        if not is_ours:
            raise NoAnswer(f"bus {self.name} was busy until the deadline")
        try:
            if self._client is None:
                raise LinkLost(f"bus {self.name} is not connected")
            return work(self._client, until_s)
        finally:
            self._lock.release()

    def rest(self, duration_s: float) -> None:
        """Sleep for `duration_s` between two requests of a caller."""
        self._rest.wait(duration_s)

    def close(self) -> None:
        """End the owner thread; a second call does nothing."""
        with self._members:
            port, self._port, self._slots = self._port, None, []
        if port is not None:
            port.close()

    def set_up(self, link: Link) -> None:
        """Create a client on the new link and mark every station for set-up (owner thread)."""
        self._line = inside(link, CountingLink)
        with self._lock:
            self._client = self._make_client(link)
        for slot in self._slots:
            slot.needs_set_up, slot.failures, slot.due_s = True, 0, 0.0

    def serve(self, link: Link) -> None:
        """Poll the station that is due, or sleep until one is (owner thread)."""
        slot = min(self._slots, key=lambda s: s.due_s, default=None)
        wait_s = IDLE_S if slot is None else slot.due_s - now_s()
        if slot is None or wait_s > 0.0:
            self._rest.wait(min(wait_s, IDLE_S))
            return
        self._let_callers_pass()
        try:
            with self._lock:
                self._serve(slot)
        except LinkLost:
            raise
        except (WireError, CellError) as error:
            self._note_failure(slot, error, link)

    def _let_callers_pass(self) -> None:
        """Wait briefly while callers are waiting: without a pause the polling thread would take the lock again every time."""
        until_s = now_s() + LONGEST_YIELD_S
        while self._callers and now_s() < until_s:
            self._rest.wait(YIELD_S)

    def _serve(self, slot: _Slot[C]) -> None:
        if self._client is None:
            raise LinkLost(f"bus {self.name} is not connected")
        if slot.needs_set_up:
            slot.station.set_up(self._client)
            slot.needs_set_up = False
        slot.due_s = max(slot.due_s + slot.station.period_s, now_s() - slot.station.period_s)
        slot.station.poll(self._client)
        slot.failures = 0

    def _note_failure(self, slot: _Slot[C], error: Exception, link: Link) -> None:
        slot.failures += 1
        backoff_s = min(slot.station.period_s * 2.0 ** max(0, slot.failures - 2), SLOWEST_POLL_S)
        slot.due_s = now_s() + backoff_s
        if slot.failures >= SET_UP_AGAIN_AFTER:
            slot.needs_set_up = True
        slot.station.fail(error)
        if isinstance(error, NoAnswer) and not link.is_present():
            raise LinkLost(f"{link.name}: its path no longer exists or now leads to another port")

    def lost(self, error: Exception) -> None:
        """Report the loss to every station (owner thread)."""
        with self._lock:
            self._client = None
        for slot in self._slots:
            slot.station.fail(error)


class PolledDevice(WireDevice[T], Generic[T, C]):
    """Device polled on a bus; the subclass defines its set-up and its poll."""

    def __init__(self, context: Context, bus: Bus[C], *, rate_hz: float, max_age_s: float) -> None:
        super().__init__(context, max_age_s=max_age_s)
        self.bus = bus
        self.rate_hz = rate_hz
        self.exchanges = ExchangeTime()

    @property
    def period_s(self) -> float:
        """Return the time between two polls, in seconds."""
        return 1.0 / self.rate_hz

    @abstractmethod
    def set_up(self, client: C) -> None:
        """Identify and configure the device; called again after each loss of the bus."""

    @abstractmethod
    def poll(self, client: C) -> None:
        """Request the newest values and publish them."""

    def fail(self, error: Exception) -> None:
        """Count a lost or bad answer as a gap in the sequence; report any other error to the readers."""
        if isinstance(error, NoAnswer | BadAnswer):
            self.errors += 1
            self._sequence += 1
            self._last_error = str(error)
            return
        super().fail(error)

    def call(self, work: Callable[[C, float], R], deadline: Deadline) -> R:
        """Run `work` on the bus in the caller's thread, with errors translated for this device.

        Raises:
            DeviceTimeout, DeviceFault, DeviceUnavailable: each names the device.
        """
        self.require_open()
        try:
            return self.bus.call(work, now_s() + deadline.remaining_s())
        except WireError as error:
            self.errors += 1
            raise self.translate(error) from error

    def join(self, timeout_s: float = CONNECT_S) -> None:
        """Attach to the bus and wait for the first sample.

        Raises:
            DeviceUnavailable: no sample arrived.
        """
        self.bus.attach(self)
        self.await_first(timeout_s)

    def release(self) -> None:
        """Detach from the bus."""
        self.bus.detach(self)

    def is_up(self) -> bool:
        """Return whether the link is open and set up."""
        return self.bus.is_up

    def reconnects(self) -> int:
        """Return how many times the link was set up again."""
        return self.bus.reconnects

    def heard_bytes(self) -> int | None:
        """Return the bus's count of received bytes, which covers all its stations."""
        return self.bus.heard_bytes

    def link_name(self) -> str:
        """Return the link's name: port and baud rate, or network address."""
        return self.bus.name
