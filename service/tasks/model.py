"""The data of a task: its states, events and artefacts."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

from hal.errors import Cancelled
from service.problem import ProblemFields, problem_of
from service.tasks.sub_leases import SubLease

MAX_EVENTS = 2000  # a task that reports more than this drops its oldest events; their sequence numbers show the gap


class TaskState(StrEnum):
    """Life of a task; `ALLOWED` draws it."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether the task has ended."""
        return not ALLOWED[self]


_S = TaskState
ALLOWED: dict[TaskState, frozenset[TaskState]] = {
    # from           to
    _S.QUEUED: frozenset({_S.RUNNING, _S.CANCELLED, _S.FAILED}),
    _S.RUNNING: frozenset({_S.CANCELLING, _S.SUCCEEDED, _S.FAILED}),
    _S.CANCELLING: frozenset({_S.CANCELLED, _S.SUCCEEDED, _S.FAILED}),  # it may end by itself first
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset(),
    _S.CANCELLED: frozenset(),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskEvent:
    """Something happened to a task. `sequence` counts from 1 without gaps; `time_s` is wall time, for people."""

    sequence: int
    time_s: float
    kind: str  # "state", "progress" or "artefact"
    state: TaskState
    fraction: float
    step: str
    detail: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Artefact:
    """A file that a task produced."""

    name: str
    media_type: str
    size_bytes: int

    @staticmethod
    def is_name(text: str) -> bool:
        """Return whether the text is a plain file name, which cannot lead out of its folder."""
        return re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", text) is not None


def set_event() -> threading.Event:
    """Return an event that is set."""
    event = threading.Event()
    event.set()
    return event


@dataclass(slots=True, kw_only=True, eq=False)
class Task:
    """One task. Its methods may be called from any thread.

    Attributes:
        moves: whether it may move the arm.
        holder: who held the lease when it was started.
        by: name of the key that asked for it; None while the service has no keys.
        key: the caller's idempotency key.
        sub_lease: its right to move; None when it does not move, and for a task of an earlier run.
        client: the machine that asked for it; tasks of one client may not fill the queue.
        can_pause: whether its work has steps between which it can stand still.
        goes_on: cleared while somebody wants it to pause.
        is_held: whether it stands still between two steps now.
        problem: why it failed, as plain values.
        created_s, started_s, ended_s: wall time, for display only.
    """

    id: str
    verb: str
    request: dict[str, Any]
    moves: bool
    holder: str | None = None
    by: str | None = None
    key: str | None = None
    sub_lease: SubLease | None = None
    client: str | None = None
    can_pause: bool = False
    goes_on: threading.Event = field(default_factory=set_event)
    is_held: bool = False
    state: TaskState = TaskState.QUEUED
    problem: ProblemFields | None = None
    artefacts: list[Artefact] = field(default_factory=list)
    events: list[TaskEvent] = field(default_factory=list)
    created_s: float = field(default_factory=time.time)
    started_s: float | None = None
    ended_s: float | None = None
    cancel_asked: threading.Event = field(default_factory=threading.Event)
    cancel_reason: str = ""
    on_change: Callable[[Task], None] | None = None
    _condition: threading.Condition = field(default_factory=threading.Condition)
    _sequence: int = 0
    _result_json: bytes = b"null"

    @property
    def result(self) -> Any:
        """What the work returned, as plain JSON values; a new copy at each call.

        It is kept as text, because the values of a mission take 50 kB and their text 10 kB, and 200 tasks are kept.
        """
        return json.loads(self._result_json)

    @result.setter
    def result(self, value: Any) -> None:
        self._result_json = json.dumps(value, separators=(",", ":")).encode()

    @property
    def fraction(self) -> float:
        """Progress of the work, from 0 to 1."""
        return self.events[-1].fraction if self.events else 0.0

    @property
    def pause(self) -> Literal["no", "asked", "held"]:
        """Whether somebody wants it to pause, and whether it stands still already."""
        if self.goes_on.is_set():
            return "no"
        return "held" if self.is_held else "asked"

    @property
    def step(self) -> str:
        """Description of the present step."""
        return self.events[-1].step if self.events else ""

    def move_to(self, state: TaskState) -> bool:
        """Change the state if `ALLOWED` permits it; returns whether it changed."""
        with self._condition:
            if state not in ALLOWED[self.state]:
                return False
            if self.state is TaskState.QUEUED and state is TaskState.CANCELLED:
                self.problem = problem_of(self.cancellation())  # no work begins that could tell why
            self.state = state
            if state is TaskState.RUNNING:
                self.started_s = time.time()
            if state.is_final:
                self.ended_s = time.time()
            done = state is TaskState.SUCCEEDED
            self._append("state", fraction=1.0 if done else self.fraction, step=self.step, detail=self._why())
            self._condition.notify_all()
        self._tell()
        return True

    def ask_cancel(self, reason: str) -> bool:
        """Request cancellation; False when the task has ended already. A queued task ends at once; a repeat is no error."""
        with self._condition:
            if self.state.is_final:
                return False
            if not self.cancel_asked.is_set():
                self.cancel_reason = reason
                self.cancel_asked.set()
            is_waiting = self.state is TaskState.QUEUED
        # A queued task may have begun to run before the first `move_to`; the second one handles that case.
        if is_waiting and self.move_to(TaskState.CANCELLED):
            return True
        self.move_to(TaskState.CANCELLING)
        return True

    def cancellation(self) -> Cancelled:
        """Return the error that ends the work after `ask_cancel`."""
        return Cancelled(
            f"task {self.id} was cancelled: {self.cancel_reason}", hint="start it again when ready", task=self.id
        )

    def add_event(self, kind: str, *, fraction: float | None = None, step: str | None = None, detail: str = "") -> None:
        """Append an event; a fraction or step that is not given stays unchanged."""
        with self._condition:
            self._append(
                kind,
                fraction=self.fraction if fraction is None else fraction,
                step=self.step if step is None else step,
                detail=detail,
            )
        self._tell()

    def add_artefact(self, artefact: Artefact) -> None:
        """Record a file that was written."""
        with self._condition:
            self.artefacts[:] = [item for item in self.artefacts if item.name != artefact.name] + [artefact]
        self.add_event("artefact", detail=artefact.name)

    def events_after(self, sequence: int) -> list[TaskEvent]:
        """Return the events with a higher sequence number."""
        with self._condition:
            return [event for event in self.events if event.sequence > sequence]

    def wait(self, timeout_s: float) -> bool:
        """Wait until the task has ended; returns whether it has."""
        with self._condition:
            return self._condition.wait_for(lambda: self.state.is_final, timeout_s)

    def _append(self, kind: str, *, fraction: float, step: str, detail: str) -> None:
        self._sequence += 1
        event = TaskEvent(
            sequence=self._sequence,
            time_s=time.time(),
            kind=kind,
            state=self.state,
            fraction=fraction,
            step=step,
            detail=detail,
        )
        self.events.append(event)
        del self.events[:-MAX_EVENTS]

    def _why(self) -> str:
        if self.problem is not None:
            return str(self.problem["detail"])
        return self.cancel_reason if self.cancel_asked.is_set() else ""

    def _tell(self) -> None:
        if self.on_change is not None:
            self.on_change(self)
