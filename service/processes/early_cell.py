"""A cell process that begins before its service knows what to order, so that both import their libraries at the same time.

This module imports little, because it is used before everything else.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from service.processes.child import Child
from service.processes.runtime_folder import RuntimeFolder

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)  # neither cell nor world multiplies large matrices


def begin_cell(folder: Path, on_line: Callable[[str], None], on_exit: Callable[[int], None]) -> Child:
    """Start a cell process, which waits for its order.

    Its temporary files lie in `folder`, so that nothing remains of one that is killed.
    """
    environment = {"TMPDIR": str(folder), **ONE_THREAD}
    return Child("service.processes.cell", environment=environment, on_line=on_line, on_exit=on_exit)


class EarlyCell:
    """A cell process without an order, with a folder for its temporary files."""

    def __init__(self) -> None:
        self.folder = RuntimeFolder()
        self._lock = threading.Lock()
        self._on_line: Callable[[str], None] = lambda _line: None  # a cell says nothing before its order
        self._on_exit: Callable[[int], None] | None = None
        self._code: int | None = None
        self.child = begin_cell(self.folder.path, self._told, self._exited)

    def take(self, on_line: Callable[[str], None], on_exit: Callable[[int], None]) -> Child:
        """Return the process, which tells these functions what it prints and how it ends; see `Child`."""
        with self._lock:
            self._on_line, self._on_exit = on_line, on_exit
            code = self._code
        if code is not None:
            on_exit(code)
        return self.child

    def close(self) -> None:
        """End the process and remove the folder; a second call does nothing."""
        self.child.kill()
        self.folder.close()

    def _told(self, line: str) -> None:
        self._on_line(line)

    def _exited(self, code: int) -> None:
        with self._lock:
            self._code, on_exit = code, self._on_exit
        if on_exit is not None:
            on_exit(code)
