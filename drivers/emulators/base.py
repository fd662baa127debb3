"""The thread of an emulator: takes requests, sends frames, and damages them as its fault plan says."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from drivers.emulators.faults import FaultOptions, FaultPlan, WireFault
from drivers.emulators.ports import FarPort, Peer
from hal.clock import Deadline, WallClock
from hal.errors import CellError, Unsupported
from hal.readings import Stamped
from hal.simulated import Fault

LOOK_UP_S = 0.02
BACKING_S = 0.2


def time_of(sample: Stamped[Any]) -> float:
    """Seconds on the clock of the device behind; the machine's when it has none.

    A simulated world stands still while it draws a picture. Its arm does too, so that its watchdogs must not count on.
    """
    return time.monotonic() if sample.device_time_s is None else sample.device_time_s


class WireEmulator:
    """Base of all emulators. The subclass gives `on_bytes` and, for devices that talk by themselves, `on_tick`."""

    period_s: float | None = None

    def __init__(self, port: FarPort, options: FaultOptions, *, name: str) -> None:
        self.port = port
        self.plan = FaultPlan(options)
        self.sent: deque[tuple[float, bytes]] = deque(maxlen=4096)  # (monotonic s, frame) of every undamaged frame
        self._clock = WallClock()
        self._closing = threading.Event()
        self._silent_until_s = 0.0
        self._is_silent = False
        self._is_out = False
        self._orders: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=f"emulator {name}", daemon=True)

    @property
    def address(self) -> dict[str, Any]:
        """Options that lead the real driver here."""
        return self.port.address

    def begin(self) -> None:
        """Start the thread; the last thing a factory does."""
        self._thread.start()

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """A peer has sent bytes (none: it has just connected)."""

    def on_tick(self) -> None:
        """Called every `period_s`."""

    def status_frame(self) -> bytes | None:
        """The device's error report in place of a frame, for the fault `status`; None when it has none."""
        return None

    def unplug(self, *, away_s: float) -> None:
        """Vanish and return; from any thread. Returns when the port is back (or the emulator closed)."""
        if threading.current_thread() is self._thread:
            self._unplug_now(away_s)
            return
        done = threading.Event()
        self._orders.put((lambda: self._unplug_now(away_s), done))
        done.wait(away_s + 2.0)

    def inject(self, fault: Fault | None) -> None:
        """Begin a fault of the conformance kit (silent or disconnected), or end it with None.

        Raises:
            Unsupported: the fault belongs to the device behind, not to the wire.
        """
        if fault not in (None, Fault.SILENT, Fault.DISCONNECTED):
            raise Unsupported(f"a wire cannot be {fault}", hint="inject it into the device behind the emulator")
        self._is_silent = fault is Fault.SILENT
        is_out, self._is_out = self._is_out, fault is Fault.DISCONNECTED
        if self._is_out != is_out:
            done = threading.Event()
            self._orders.put((self.port.vanish if self._is_out else self.port.appear, done))
            done.wait(2.0)

    def _unplug_now(self, away_s: float) -> None:
        # Only the emulator's own thread touches the port: a descriptor closed under another thread may be reused.
        self.port.vanish()
        self._closing.wait(away_s)
        if not self._closing.is_set():
            self.port.appear()

    def close(self) -> None:
        """End thread and port; a second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join(2.0)
            self.port.close()

    def deadline(self) -> Deadline:
        """For reads of the device behind the emulator."""
        return Deadline.after(self._clock, BACKING_S)

    def send(self, peer: Peer, frame: bytes, *, protected: slice = slice(None)) -> None:
        """Send one frame through the fault plan.

        Args:
            protected: the part of the frame whose damage the protocol can see.
        """
        if self._is_silent or time.monotonic() < self._silent_until_s:
            return
        fault = self.plan.next()
        if fault is None or fault is WireFault.ECHO:
            self._deliver(peer, frame)
        else:
            self._damage(fault, peer, frame, protected)

    def reply(self, peer: Peer, data: bytes) -> None:
        """Send what belongs to the set-up and not to the data, undamaged unless silent."""
        if not self._is_silent:
            self.port.send(peer, data)

    def _deliver(self, peer: Peer, frame: bytes) -> None:
        self.sent.append((time.monotonic(), frame))
        self.port.send(peer, frame)

    def _damage(self, fault: WireFault, peer: Peer, frame: bytes, protected: slice) -> None:
        options = self.plan.options
        match fault:
            case WireFault.CRC:
                self.port.send(peer, self.plan.flip_bit(frame, protected))
            case WireFault.DROP:
                self.port.send(peer, self.plan.lose_bytes(frame))
            case WireFault.DUP:
                self._deliver(peer, frame)
                self.port.send(peer, frame)
            case WireFault.SPLIT:
                self.port.send(peer, frame[: len(frame) // 2])
                self._closing.wait(options.split_s)
                self._deliver(peer, frame[len(frame) // 2 :])
            case WireFault.DELAY:
                self._closing.wait(options.delay_s)
                self._deliver(peer, frame)
            case WireFault.SILENT:
                self._silent_until_s = time.monotonic() + options.silent_s
            case WireFault.GARBAGE:
                self.port.send(peer, self.plan.noise(frame))
                self._deliver(peer, frame)
            case WireFault.STATUS:
                self.port.send(peer, self.status_frame() or frame)
            case _:
                self.port.send(peer, frame[: len(frame) // 2])
                self.unplug(away_s=options.away_s)

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._closing.is_set():
            self._take_orders()
            wait_s = LOOK_UP_S if self.period_s is None else min(LOOK_UP_S, next_s - time.monotonic())
            received = self.port.receive(wait_s)
            for peer, data in received:
                self._take(peer, data)
            if self.period_s is not None and time.monotonic() >= next_s:
                next_s = max(next_s + self.period_s, time.monotonic() - self.period_s)
                self._guarded_tick()

    def _take_orders(self) -> None:
        with suppress(queue.Empty):
            order, done = self._orders.get_nowait()
            order()
            done.set()

    def _take(self, peer: Peer, data: bytes) -> None:
        if data and self.plan.options.fault is WireFault.ECHO:
            self.port.send(peer, data)
        try:
            self.on_bytes(peer, data)
        except CellError:
            return  # the device behind says nothing, so neither does the wire

    def _guarded_tick(self) -> None:
        try:
            self.on_tick()
        except CellError:
            return
