"""A simulated cell for rounds: tasks that outlive the keeper, a lease, and deaths at any step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.errors import CellError
from hal.plant import RoundSection
from service.rounds.book import RoundBook, Run
from service.rounds.keeper import RoundKeeper
from service.tasks.model import Task, TaskState

DURATION_S = 180.0


class Killed(BaseException):
    """The process ends here; nothing that follows takes place."""


@dataclass(kw_only=True)
class Rig:
    """Rounds on a clock that tests set; `restart` is what kill -9 and a new start do."""

    folder: Path
    sections: list[RoundSection]
    now_s: float
    forbids: str | None = None
    error: CellError | None = None
    dies: Callable[[str], bool] = lambda _where: False
    tasks: dict[str, Task] = field(default_factory=dict)
    queues: bool = False
    newest: Task | None = None

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.book = _MortalBook(self.folder / "rounds.sqlite", self.dies)
        self.keeper = RoundKeeper(self.sections, book=self.book, cell=self, now_s=lambda: self.now_s)

    def restart(self) -> None:
        """End the service without notice, and start it again."""
        self.book.close()
        for task in self.tasks.values():
            if not task.state.is_final:
                task.problem = {"type": "urn:panelwright:aborted", "detail": "the service ended"}  # type: ignore[typeddict-item]
                task.state = TaskState.FAILED
        self.start()

    def why_not(self, _section: RoundSection) -> str | None:
        is_moving = self.newest is not None and not self.newest.state.is_final
        return self.forbids or ("a task moves" if is_moving else None)

    def begin(self, section: RoundSection, key: str) -> Task:
        self.die("before the task")
        if self.error is not None:
            raise self.error
        task = self.newest = self.tasks.setdefault(key, Task(id=key, verb="missions", request={}, moves=True, key=key))
        if not self.queues:
            task.state, task.started_s = TaskState.RUNNING, self.now_s
        self.die("after the task")
        return task

    def with_key(self, key: str) -> Task | None:
        return self.tasks.get(key)

    def die(self, where: str) -> None:
        if self.dies(where):
            raise Killed(where)

    def pass_to(self, now_s: float) -> None:
        """Let the time pass; tasks end when they are done."""
        self.now_s = now_s
        task = self.newest
        if task is not None and task.state is TaskState.RUNNING and now_s - (task.started_s or 0.0) >= DURATION_S:
            task.state = TaskState.SUCCEEDED

    def tick(self, after_s: float = 0.0) -> None:
        self.pass_to(self.now_s + after_s)
        self.keeper.tick()

    def states(self, name: str | None = None) -> list[str]:
        """Return the states of the runs, oldest first."""
        return [str(run.state) for run in reversed(self.keeper.runs(name, limit=10_000))]


class _MortalBook(RoundBook):
    """A record that a process may die before or after writing to."""

    def __init__(self, path: Path, dies: Callable[[str], bool]) -> None:
        super().__init__(path)
        self._dies = dies

    def begin(self, *given: Any) -> Run:
        self._die("before the beginning is recorded")
        run = super().begin(*given)
        self._die("after the beginning is recorded")
        return run

    def running(self, *given: Any) -> None:
        super().running(*given)
        self._die("after the task is recorded")

    def end(self, *given: Any, **named: Any) -> None:
        self._die("before the end is recorded")
        super().end(*given, **named)
        self._die("after the end is recorded")

    def _die(self, where: str) -> None:
        if self._dies(where):
            raise Killed(where)


def section(name: str = "morning", **given: Any) -> RoundSection:
    """Return a round; by default one each hour in UTC."""
    return RoundSection(**{"name": name, "cron": "0 * * * *", **given})
