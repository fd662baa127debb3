"""Makes the arm slow while people are near, and remembers that when the service ends."""

from __future__ import annotations

import threading
from pathlib import Path

from hal.atomic_write import flush_folder, write_atomically
from hal.errors import MotionRefused
from hal.isolated import Report
from service.processes.latch import Latch


class SpeedDesk:
    """The reduced speed, which the control thread reads in each tick.

    Args:
        latch: shared memory that the control thread reads.
        path: a file that exists while the speed is reduced, so that a restart leaves it reduced.
        commit: records a change and returns when it is on disk; raises when it cannot be written.
    """

    def __init__(self, latch: Latch, path: Path, commit: Report) -> None:
        self._latch, self._path, self._commit = latch, path, commit
        self._changing = threading.Lock()
        self._asked = 0
        latch.reduce(path.exists())

    @property
    def is_reduced(self) -> bool:
        """Whether the reduced speed holds."""
        return self._latch.is_reduced()

    def reduce(self, source: str) -> None:
        """Make the arm slow at once; then record it.

        Raises:
            JournalError, OSError: it cannot be recorded or remembered; the reduced speed holds all the same.
        """
        self._asked += 1
        self._latch.reduce(True)  # without waiting for a restore that is being recorded
        with self._changing:
            self._latch.reduce(True)
            write_atomically(self._path, source)
            self._commit("speed-reduced", {"source": source})

    def restore(self, source: str) -> None:
        """Let the speed of the cell hold again, after this is recorded.

        Raises:
            MotionRefused: somebody reduced it again meanwhile.
            JournalError, OSError: it cannot be recorded or remembered, so the speed stays reduced.
        """
        asked = self._asked
        with self._changing:
            self._commit("speed-restored", {"source": source})
            if self._asked != asked:
                raise MotionRefused(
                    "the speed was reduced again meanwhile", hint="look at the cell, then restore again"
                )
            self._path.unlink(missing_ok=True)
            flush_folder(self._path.parent)
            self._latch.reduce(False)
