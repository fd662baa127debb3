"""What a task offers to the operation that it runs: progress, cancellation, pauses, and files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hal.errors import InvalidRequest
from service.tasks.model import Artefact, Task

MAX_ARTEFACT_BYTES = 64_000_000
HOLD_S = 0.2  # between two looks at a pause: so late is a stop seen in one, at most


class TaskContext:
    """The interface of a task for the operation that it runs."""

    def __init__(self, task: Task, folder: Path) -> None:
        self._task = task
        self._folder = folder
        self._may_go_on: Callable[[], None] = lambda: None

    @property
    def id(self) -> str:
        """Identity of the task."""
        return self._task.id

    @property
    def is_cancelled(self) -> bool:
        """Whether cancellation of this task was requested."""
        return self._task.cancel_asked.is_set()

    def progress(self, fraction: float, step: str, detail: str = "") -> None:
        """Report the progress (0 to 1) and the present step.

        Raises:
            Cancelled: the task was cancelled.
            CellError: what ends it besides; see `end_when`.
        """
        self.check_cancelled()
        self._may_go_on()
        self._task.add_event("progress", fraction=min(1.0, max(0.0, fraction)), step=step, detail=detail)

    def check_cancelled(self) -> None:
        """Raise `Cancelled` when cancellation of this task was requested."""
        if self.is_cancelled:
            raise self._task.cancellation()

    def end_when(self, check: Callable[[], None]) -> None:
        """Have `progress` call `check`, whose error ends the work before its next motion would."""
        self._may_go_on = check

    def pause_point(self, hold: Callable[[], object]) -> None:
        """Stand still between two steps for as long as somebody wants a pause; `hold` is called again and again meanwhile.

        Raises:
            Cancelled: the task was cancelled.
        """
        if self._task.goes_on.is_set():
            return
        self._task.is_held = True
        self._task.add_event("progress", detail="paused")
        try:
            while not self._task.goes_on.is_set():
                self.check_cancelled()
                hold()
                self._task.goes_on.wait(HOLD_S)
        finally:
            self._task.is_held = False
        self._task.add_event("progress", detail="goes on")

    def artefact(self, name: str, data: bytes, media_type: str) -> str:
        """Store a file with the task; returns its URL path.

        Raises:
            InvalidRequest: the name is not a plain file name, or the file is too large.
        """
        if not Artefact.is_name(name) or len(data) > MAX_ARTEFACT_BYTES:
            raise InvalidRequest(
                f"artefact {name!r} has a bad name or more than {MAX_ARTEFACT_BYTES} bytes",
                hint="letters, digits, dot, dash and underscore",
            )
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / name).write_bytes(data)
        self._task.add_artefact(Artefact(name=name, media_type=media_type, size_bytes=len(data)))
        return f"/v1/tasks/{self._task.id}/artefacts/{name}"
