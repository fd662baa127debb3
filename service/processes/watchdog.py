"""Gives the heartbeat of the stop process and watches those of the service and the cell.

This module imports little, because the stop process must start fast and stay small.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path

from hal.priorities import Priority, take_priority
from service.processes.beat import PERIOD_S, Beat
from service.processes.latch import Latch, StopLevel

LOOP_SILENT_S = 0.06  # an event loop that showed no life for so long gives no heartbeat


class Watchdog:
    """Gives the heartbeat of this process and latches the stop when the service or the cell has none.

    A thread of its own does so, because others tell from its waiting for the lock of Python that the event loop hangs. If the
    event loop shows no life, it gives no heartbeat either.

    Args:
        folder: runtime folder of the service.
        silence_s: see `Beat.lost`.
        service_lost: what the loss of the service does; that of the cell always switches off.
    """

    def __init__(
        self, latch: Latch, folder: Path, *, silence_s: float, service_lost: StopLevel = StopLevel.OFF
    ) -> None:
        self._latch = latch
        self._own = Beat(folder, "stop")
        self._others = {
            "service": (Beat(folder, "service"), service_lost),
            "cell": (Beat(folder, "cell"), StopLevel.OFF),
        }
        self._silence_s = silence_s
        self._loop_lived_s = time.monotonic()
        self._end = threading.Event()

    def look(self) -> None:
        """Give one heartbeat and look at those of the others once; a loss is one stop, however long it lasts."""
        if time.monotonic() - self._loop_lived_s < LOOP_SILENT_S:
            self._own.beat()
        for name, (beat, level) in self._others.items():
            if not self._latch.has(level) and (why := beat.lost(silence_s=self._silence_s)) is not None:
                self._latch.set(f"the {name} process {why}", level)

    def keep(self) -> None:
        """Look until the end, in a thread of its own."""
        take_priority(Priority.STOP)
        while not self._end.wait(PERIOD_S):
            self.look()

    async def show_life(self) -> None:
        """Show that the event loop lives, until cancelled."""
        while True:
            self._loop_lived_s = time.monotonic()
            await asyncio.sleep(PERIOD_S)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Look, and show that the event loop lives, while the context lasts."""
        thread = threading.Thread(target=self.keep, name="heartbeat", daemon=True)
        thread.start()
        living = asyncio.create_task(self.show_life())
        try:
            yield
        finally:
            living.cancel()
            self._end.set()
            thread.join()
