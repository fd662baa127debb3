"""Gives the heartbeat of the cell process and watches what the cell cannot run without."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from hal import pauses
from service.processes.beat import PERIOD_S, Beat
from service.processes.cell_lines import BLOCKED, LOST, note_to_line
from service.processes.child import Lifeline, kill_own_group

log = logging.getLogger(__name__)


class Vigil:
    """Gives the heartbeat of the cell and watches what the cell cannot run without.

    Without a stop process nobody can stop the arm, so `is_alone` counts as a stop. Without its world the cell has no
    devices: it tells the supervisor and ends, so that both are started again. A control thread that is blocked counts as a
    stop, too: it brakes when it comes back, and the cell ends when it does not.
    """

    def __init__(self, folder: Path, lifeline: Lifeline, *, silence_s: float) -> None:
        self._lifeline = lifeline
        self._own, self._stop = Beat(folder, "cell"), Beat(folder, "stop")
        self._silence_s = silence_s
        pauses.tell(self._own.pause)
        self._lost: Callable[[], str | None] = lambda: None
        self._blocked: Callable[[], str | None] = lambda: None
        self.is_alone = self.is_blocked = False

    def watch(self, lost: Callable[[], str | None], blocked: Callable[[], str | None] = lambda: None) -> None:
        """Also watch what `lost` and `blocked` look at: why the cell must end, and why nothing may move; None for neither."""
        self._lost, self._blocked = lost, blocked

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
