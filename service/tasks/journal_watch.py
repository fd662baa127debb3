"""Watches whether the journal can record; without a record nothing may move."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from service.tasks.journal import Journal

PERIOD_S = 0.2
PROBE_BYTES = 65_536  # more than a commit needs, so that a disk that fills is noticed before a row is lost


class JournalWatch:
    """Looks several times a second whether the journal exists and its disk takes more data.

    Args:
        on_failure: called with the reason in each look that finds that nothing can be recorded.
    """

    def __init__(self, journal: Journal, on_failure: Callable[[str], None]) -> None:
        self._journal = journal
        self._on_failure = on_failure
        self._losses = journal.losses
        self._end = threading.Event()
        self.problem: str | None = None

    def start(self) -> None:
        """Look in a thread of its own until closed."""
        threading.Thread(target=self._run, name="journal-watch", daemon=True).start()

    def look(self) -> None:
        """Look once."""
        self.problem = self._found()
        if self.problem is not None:
            self._on_failure(self.problem)
            self._journal.try_again()

    def close(self) -> None:
        """End the thread; a second call does nothing."""
        self._end.set()

    def _run(self) -> None:
        while not self._end.wait(PERIOD_S):
            self.look()

    def _found(self) -> str | None:
        losses, self._losses = self._losses, self._journal.losses
        if losses != self._losses or self._journal.is_lost():
            return "the journal was deleted"
        if self._journal.failure is not None:
            return f"the journal cannot be written: {self._journal.failure}"
        try:
            _probe(self._journal.path.with_suffix(".probe"))
        except OSError as error:
            return f"the journal's disk takes no data: {error.strerror or error}"
        return None


def _probe(path: Path) -> None:
    """Write a file and remove it.

    Raises:
        OSError: the disk is full or read-only, or the folder is gone.
    """
    with path.open("wb", buffering=0) as file:
        try:
            if file.write(bytes(PROBE_BYTES)) != PROBE_BYTES:
                raise OSError("the disk is full")
        finally:
            path.unlink()
