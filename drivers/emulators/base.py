"""Base class of all emulators: one thread receives requests, sends frames and injects faults."""

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
    """Return the sample's time in seconds on the backing device's clock, or on the host's if the device has no clock.

    A simulated world stands still while it renders an image, and so does its arm. Watchdogs must therefore use the
    world's clock, because on the host's clock they would trip.
    """
    return time.monotonic() if sample.device_time_s is None else sample.device_time_s


class WireEmulator:
    """Base of all emulators: the subclass defines `on_bytes` and, for devices that send unasked, `on_tick`."""

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
        """Return the driver options that make the real driver connect to this emulator."""
        return self.port.address

    def begin(self) -> None:
        """Start the thread; a factory calls this last."""
        self._thread.start()

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Handle bytes from a peer; empty bytes mean that it has just connected."""

    def on_tick(self) -> None:
        """Do the periodic work; called every `period_s`."""

    def status_frame(self) -> bytes | None:
        """Return the error report that the fault `status` sends in place of a frame; None if the device has none."""
        return None

    def unplug(self, *, away_s: float) -> None:
        """Remove the port for `away_s` seconds and wait until it is back or the emulator closed; for any thread."""
        if threading.current_thread() is self._thread:
            self._unplug_now(away_s)
            return
        done = threading.Event()
        self._orders.put((lambda: self._unplug_now(away_s), done))
        done.wait(away_s + 2.0)

    def inject(self, fault: Fault | None) -> None:
        """Begin a fault of the conformance tests (silent or disconnected), or end it with None.

        Raises:
            Unsupported: the fault concerns the backing device, not the link.
        """
        if fault not in (None, Fault.SILENT, Fault.DISCONNECTED):
            raise Unsupported(
                f"an emulator can make its link silent or disconnected, but not {fault}",
                hint="inject this fault into the device that backs the emulator",
            )
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
        """End the thread and close the port; a second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join(2.0)
            self.port.close()

    def deadline(self) -> Deadline:
        """Return a deadline for one read of the backing device."""
        return Deadline.after(self._clock, BACKING_S)

    def send(self, peer: Peer, frame: bytes, *, protected: slice = slice(None)) -> None:
        """Send one frame through the fault plan.

        Args:
            protected: part of the frame in which the protocol detects damage.
        """
        if self._is_silent or time.monotonic() < self._silent_until_s:
            return
        fault = self.plan.next()
        if fault is None or fault is WireFault.ECHO:
            self._deliver(peer, frame)
        else:
            self._damage(fault, peer, frame, protected)

    def reply(self, peer: Peer, data: bytes) -> None:
        """Send a set-up answer: it is never damaged, but suppressed while the emulator is silent."""
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
            return  # the backing device does not answer, so the emulator does not either

    def _guarded_tick(self) -> None:
        try:
            self.on_tick()
        except CellError:
            return
