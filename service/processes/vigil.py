"""Gives the heartbeat of the cell process and watches what the cell cannot run without."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from hal import pauses
from hal.config import LossAction
from hal.motion import CellSignals
from service.processes.beat import PERIOD_S, Beat
from service.processes.cell_lines import BLOCKED, LOST, note_to_line
from service.processes.child import Lifeline, kill_own_group
from service.processes.latch import Latch

log = logging.getLogger(__name__)


class Vigil:
    """Gives the heartbeat of the cell and watches what the cell cannot run without.

    Without a stop process nobody can stop the arm, so `is_alone` counts as a stop. Without its world the cell has no
    devices: it tells the supervisor and ends, so that both are started again. A control thread that is blocked counts as a
    stop, too: it brakes when it comes back, and the cell ends when it does not. A cell whose service has ended is an orphan,
    which counts as a stop as well and may let the arm go back.

    Attributes:
        is_orphan: set when the service has ended.
    """

    def __init__(self, folder: Path, lifeline: Lifeline, *, silence_s: float) -> None:
        self._lifeline = lifeline
        self._own, self._stop = Beat(folder, "cell"), Beat(folder, "stop")
        self._silence_s = silence_s
        pauses.tell(self._own.pause)
        self._lost: Callable[[], str | None] = lambda: None
        self._blocked: Callable[[], str | None] = lambda: None
        self.is_alone = self.is_blocked = False
        self.is_orphan = threading.Event()

    def watch(self, lost: Callable[[], str | None], blocked: Callable[[], str | None] = lambda: None) -> None:
        """Also watch what `lost` and `blocked` look at: why the cell must end, and why nothing may move; None for neither."""
        self._lost, self._blocked = lost, blocked

    def is_latched(self, latch: Latch) -> bool:
        """Return whether nothing may begin to move."""
        return self.is_orphan.is_set() or self._is_helpless() or latch.is_set()

    def signals(self, latch: Latch, *, service_lost: LossAction) -> CellSignals:
        """Return what the control thread asks in each tick besides `is_latched`.

        Args:
            service_lost: the choice of the cell file. While the service is only silent, the stop process latches by it.
        """

        def keeps_power() -> bool:
            return latch.keeps_power() and not self.is_orphan.is_set() and not self._is_helpless()

        def goes_back() -> bool:
            is_own = service_lost == "retreat" and self.is_orphan.is_set() and not latch.is_set()
            return (is_own or latch.goes_back()) and not self._is_helpless()

        return CellSignals(is_reduced=latch.is_reduced, keeps_power=keeps_power, goes_back=goes_back)

    def _is_helpless(self) -> bool:
        return self.is_alone or self.is_blocked

    def keep(self) -> None:
        """Give heartbeats and watch, endlessly."""
        pause = threading.Event()
        while True:
            try:
                self.look()
            except Exception:  # a defect of a resource must not look like a cell that hangs
                log.exception("watching the resources of the cell")
                self._lost = self._blocked = lambda: None
            pause.wait(PERIOD_S)

    def look(self) -> None:
        """Give one heartbeat and look once."""
        self._own.beat()
        self.is_alone = self._stop.lost(silence_s=self._silence_s) is not None
        why = self._blocked()
        if why is not None and not self.is_blocked:
            self._lifeline.write_line(note_to_line(BLOCKED, {"why": why}))
        self.is_blocked = why is not None
        if (why := self._lost()) is not None:
            self._lifeline.write_line(note_to_line(LOST, {"why": why}))
            kill_own_group()
