"""Begins each round at its time, one at a time, and never while something forbids it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from hal.errors import CellError, ConfigError, InvalidRequest
from hal.plant import RoundSection
from service.errors import NoSuchTask, NotPossibleNow
from service.rounds.book import NEWER, RoundBook, Run, RunState
from service.rounds.schedule import times_after, times_between
from service.tasks.model import Task, TaskState

MOST_MISSED = 500  # runs that are recorded one by one after a long absence; older ones are only counted
ENDS = {
    TaskState.SUCCEEDED: RunState.SUCCEEDED,
    TaskState.FAILED: RunState.FAILED,
    TaskState.CANCELLED: RunState.CANCELLED,
}
OVER = "the window was over before it could begin"
log = logging.getLogger(__name__)


class Cell(Protocol):
    """What the keeper asks of the cell."""

    def why_not(self, section: RoundSection) -> str | None:
        """Return why a round may not begin now; None if it may."""
        ...

    def begin(self, section: RoundSection, key: str) -> Task:
        """Start the mission of a round; the same key returns the same task.

        Raises:
            InvalidRequest, ConfigError: the mission cannot be run, now or later.
            CellError: it cannot be started now.
        """
        ...

    def with_key(self, key: str) -> Task | None:
        """Return the task that was started with a key, also by an earlier service; None if there is none."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Prospect:
    """What comes next of a round: its next time, and the run that waits, with what it waits for."""

    section: RoundSection
    is_of_file: bool
    next_s: float
    waiting_s: float | None
    waits_for: str


class RoundKeeper:
    """Runs the rounds of a cell.

    A run is due at its time. It begins then, or up to `window_s` later, as soon as nothing forbids it. Afterwards it is missed
    or, with `missed = "late"`, still begins; of several runs that wait, the newest begins and the others are missed.

    Args:
        sections: rounds of the cell file.
        book: the durable record.
        cell: what begins and forbids runs.
        now_s: seconds since 1970.
    """

    def __init__(
        self,
        sections: Sequence[RoundSection],
        *,
        book: RoundBook,
        cell: Cell,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._book, self._cell, self._now_s = book, cell, now_s
        self._lock = threading.RLock()
        self._of_file = {one.name: one for one in sections}
        self._defined = {one.name: one for one in book.definitions()}
        self._reasons: dict[str, str] = {}
        self._settled: dict[str, float] = {}
        self._next: dict[str, float] = {}
        self._running: tuple[Run, Task] | None = None
        self._is_resumed = False
        self._note_all_settled()

    def prospects(self) -> list[Prospect]:
        """Return all rounds with what comes next."""
        with self._lock:
            now_s, found = self._now_s(), []
            for one in self._sections():
                settled_s = self._settled[one.name]
                waiting = times_between(one.cron, one.zone, settled_s, now_s)[-1:]
                next_s = next(times_after(one.cron, one.zone, max(now_s, settled_s)))
                found.append(
                    Prospect(
                        section=one,
                        is_of_file=one.name in self._of_file,
                        next_s=next_s,
                        waiting_s=waiting[0] if waiting else None,
                        waits_for=self._reasons.get(one.name, "") if waiting else "",
                    )
                )
            return found

    def runs(self, name: str | None = None, *, limit: int = 100) -> list[Run]:
        """Return the newest runs of a round, or of all, newest first."""
        return self._book.runs(name, limit=limit)

    def define(self, section: RoundSection) -> None:
        """Add or replace a round; its first run is the first one that is due after now.

        Raises:
            NotPossibleNow: the cell file defines a round of this name.
            HistoryError: it cannot be stored.
        """
        with self._lock:
            self._check_not_of_file(section.name)
            self._book.define(section, self._now_s())
            self._defined[section.name] = section
            self._note_settled(section)

    def remove(self, name: str) -> None:
        """Remove a round that was defined over the API; a run that has begun goes on.

        Raises:
            NoSuchTask: there is no such round.
            NotPossibleNow: the cell file defines it.
        """
        with self._lock:
            self._check_not_of_file(name)
            if name not in self._defined:
                raise NoSuchTask(f"there is no round {name!r}", hint="GET /v1/rounds lists them")
            self._book.forget(name)
            del self._defined[name]

    def tick(self) -> None:
        """Record what has ended or is missed, and begin what is due; a failure is tried again at the next call."""
        with self._lock:
            try:
                if not self._is_resumed:
                    self._take_up()
                    self._is_resumed = True
                self._follow()
                waiting = sorted(
                    (due_s, section.name, section)
                    for section in self._sections()
                    if (due_s := self._due_of(section)) is not None
                )
                for due_s, _, section in waiting:
                    self._begin_if_allowed(section, due_s)
            except Exception as error:  # also after a defect, the record says what has begun
                self._is_resumed, self._running = False, None
                log.error("rounds: %s", error.what if isinstance(error, CellError) else repr(error))

    def _sections(self) -> list[RoundSection]:
        return list({**self._defined, **self._of_file}.values())

    def _check_not_of_file(self, name: str) -> None:
        if name in self._of_file:
            raise NotPossibleNow(
                f"the round {name} stands in the cell file",
                hint="change it there, and restart the service",
                state="fixed",
            )

    def _note_all_settled(self) -> None:
        for section in self._sections():
            self._note_settled(section)

    def _note_settled(self, section: RoundSection) -> None:
        settled_s = self._book.settled_s(section, self._now_s())
        self._settled[section.name] = settled_s
        self._next[section.name] = next(times_after(section.cron, section.zone, settled_s))

    def _follow(self) -> None:
        """Record the end of the run that has begun."""
        if self._running is None or not self._running[1].state.is_final:
            return
        run, task = self._running
        state, why = ENDS[task.state], ""
        if task.problem is not None:
            why = str(task.problem["detail"])
            if task.problem["type"].endswith(":aborted"):
                state = RunState.INTERRUPTED
        elif task.state is TaskState.CANCELLED:
            why = task.cancel_reason
        if state is RunState.INTERRUPTED and task.started_s is None:
            self._book.withdraw(run)  # it only waited in the queue, so it may begin again
        else:
            self._book.end(run, state, now_s=self._now_s(), why=why)
        self._running = None
        self._note_all_settled()

    def _take_up(self) -> None:
        """Find the task of a run that an earlier service began; without one, nothing of it has begun."""
        run = self._book.open_run()
        if run is None:
            return
        task = self._cell.with_key(run.key)
        if task is not None:
            self._book.running(run, task.id)
            self._running = (run, task)
        elif run.state is RunState.BEGINNING:
            self._book.withdraw(run)
            self._note_all_settled()
        else:
            self._book.end(run, RunState.INTERRUPTED, now_s=self._now_s(), why="the service ended while it ran")

    def _due_of(self, section: RoundSection) -> float | None:
        """Return the time of the newest run that waits; older ones, and one whose window is over, are missed."""
        now_s = self._now_s()
        if section.name not in self._next:
            self._note_settled(section)
        if now_s < self._next[section.name]:
            return None
        dues_s = times_between(section.cron, section.zone, self._settled[section.name], now_s)
        self._miss(section, dues_s[:-1], NEWER)
        due_s = dues_s[-1]
        if now_s > due_s + section.window_s and section.missed == "skip":
            reason = self._reasons.get(section.name)
            self._miss(section, [due_s], f"{OVER}: {reason}" if reason else OVER)
            return None
        return due_s

    def _miss(self, section: RoundSection, dues_s: Sequence[float], why: str) -> None:
        if not dues_s:
            return
        left_out = len(dues_s) - MOST_MISSED
        more = f" ({left_out} still older ones are not listed)" if left_out > 0 else ""
        self._book.miss(section, dues_s[-MOST_MISSED:], why=why + more)
        self._note_settled(section)

    def _begin_if_allowed(self, section: RoundSection, due_s: float) -> None:
        reason = "another round runs" if self._running is not None else self._cell.why_not(section)
        if reason is not None:
            self._reasons[section.name] = reason
            return
        run = self._book.begin(section, due_s, self._now_s())
        try:
            task = self._cell.begin(section, run.key)
        except (InvalidRequest, ConfigError) as error:
            self._book.end(run, RunState.FAILED, now_s=self._now_s(), why=error.what)
        except CellError as error:  # somebody took the lease meanwhile, for example
            self._book.withdraw(run)
            self._reasons[section.name] = error.what
        else:
            self._book.running(run, task.id)
            self._running = (run, task)
            self._reasons.pop(section.name, None)
        self._note_settled(section)
