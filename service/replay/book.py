"""The recorded cell: objects with the names and methods of the recorded ones, which give the recorded answers.

Answers are matched by the order of the calls of one task to one device. Motions are played back, not computed again:
recorded sensors could not react to a new one. What only looks (`LOOKS`) may be asked any number of times.
"""

from __future__ import annotations

import pickle
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hal.caller import caller
from hal.clock import Deadline
from hal.config import Cell
from hal.errors import CellError, Retry, Unsupported
from hal.motion import CartesianPath, GripperMotion, JointTrajectory
from service.processes.cell import CellRuntime
from service.processes.connection import CLOCK, PREFIX, SWAPPER
from service.recording.codec import decode_error, encode
from service.recording.reader import RecordedCall, RecordedTask, Recording

LOOKS = ("now_s", "state", "capabilities", "health")
NOTHING_TO_DO = ("cancel", "close", "disconnect")
NEAR_M, NEAR_RAD = 1e-3, 1e-3  # a motion that ends this close to the recorded one sees the same


class NotRecorded(CellError):
    """A replayed cell was asked for something that the recording has no answer for."""

    retry = Retry.AFTER_FIX


@dataclass(slots=True, eq=False)
class Book:
    """The recorded answers, and how far each task has read in them. Threads may share it.

    Attributes:
        differences: calls whose arguments were not those of the recording to the bit, in words.
        refused: the first call that could not be answered.
    """

    recording: Recording
    differences: list[str] = field(default_factory=list)
    refused: NotRecorded | None = None
    _pages: dict[str, _Pages] = field(default_factory=dict)
    _newest: dict[tuple[str, str], RecordedCall] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def answer(self, target: str, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the recorded answer, or raise the recorded error.

        Raises:
            NotRecorded: the recording has no answer to this call.
        """
        who = caller()
        with self._lock:
            call = self._task_call(who, target, method, args, kwargs) if who else self._newest_call(target, method)
        if call.error is not None:
            raise decode_error(call.error)
        return self._as_sent(self.recording.value(call.value))

    def left(self, task: RecordedTask) -> int:
        """Return how many calls of a recorded task were not asked for again."""
        for pages in self._pages.values():
            if pages.task is task:
                return sum(len(calls) for calls in pages.strict.values())
        return sum(call.method not in LOOKS for call in task.calls)

    def _task_call(
        self, who: str, target: str, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> RecordedCall:
        pages = self._pages.get(who) or self._open(who)
        if method in LOOKS:
            call = pages.look(target, method) or self._newest_call(target, method)
        else:
            call = self._next(pages, target, method, args, kwargs)
        self._newest[target, method] = call
        return call

    def _open(self, who: str) -> _Pages:
        """Return the pages of a task that makes its first call: those of the next recorded task of its verb."""
        verb, _, _ = who.partition(" ")
        used = {id(pages.task) for pages in self._pages.values()}
        for task in self.recording.tasks:
            if task.verb == verb and task.calls and id(task) not in used:
                self._pages[who] = _Pages.of(task)
                return self._pages[who]
        recorded = ", ".join(task.verb for task in self.recording.tasks) or "none"
        raise NotRecorded(
            f"{self.recording.path} holds no further task {verb!r}",
            hint=f"recorded tasks: {recorded}; each can be replayed once",
        )

    def _next(
        self, pages: _Pages, target: str, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> RecordedCall:
        waiting = pages.strict.get(target)
        if not waiting:
            raise self._refuse(pages, target, method, "the recording holds no further call of it")
        call = waiting[0]
        if call.method != method:
            raise self._refuse(pages, target, method, f"recorded was {call}")
        asked = [value for value in args if not isinstance(value, Deadline)]
        named = {key: value for key, value in kwargs.items() if not isinstance(value, Deadline)}
        if (
            self._written(asked) != call.arguments
            or {k: self._written([v])[0] for k, v in named.items()} != call.keywords
        ):
            why = self._why_not(call, asked)
            if why:
                raise self._refuse(pages, target, method, why)
            self.differences.append(f"{call}: {_name(asked)} differs from the recorded one, and ends at the same place")
        return waiting.popleft()

    def _written(self, asked: list[Any]) -> Any:
        return encode(self._as_sent(tuple(asked)))

    def _as_sent(self, value: Any) -> Any:
        """Return a value as it arrives in another process, if the recorded one did: pickling turns poses in their last bits."""
        return value if self.recording.was_inline else pickle.loads(pickle.dumps(value))  # noqa: S301 - our own

    def _why_not(self, call: RecordedCall, asked: list[Any]) -> str:
        """Return why a call with other arguments has another answer; an empty text if the answer is as good."""
        if call.method != "execute" or len(asked) != 1:
            return f"recorded was {call} with {call.arguments or call.keywords}"
        recorded = self.recording.value(call.arguments[0])
        off = distance(recorded, asked[0])
        if off is None:
            return f"recorded was motion {recorded.name!r}"
        return "" if off <= 1.0 else f"motion {asked[0].name!r} ends elsewhere than the recorded one"

    def _refuse(self, pages: _Pages, target: str, method: str, why: str) -> NotRecorded:
        version = self.recording.about.get("panelwright", "that wrote it")
        hint = f"the code path has changed since: replay it with panelwright {version}, or record the task again"
        if self.recording.is_cut and not any(pages.strict.values()):
            hint = f"the recording was cut off at {self.recording.end_s:.3f} s of the cell; it replays up to there"
        total = sum(call.method not in (*LOOKS, *NOTHING_TO_DO) for call in pages.task.calls)
        done = total - sum(len(calls) for calls in pages.strict.values())
        error = NotRecorded(
            f"task {pages.task.verb} asks for {target}.{method} after call {done} of {total}, but {why}",
            hint=hint,
            call=f"{target}.{method}",
        )
        self.refused = self.refused or error
        return error

    def _newest_call(self, target: str, method: str) -> RecordedCall:
        """Return the answer for somebody who only looks: the newest one given to a task, or the first in the recording."""
        found = self._newest.get((target, method))
        if found is not None:
            return found
        told = self.recording.objects.get(target, {})
        if method in ("capabilities", "health") and told.get(method) is not None:
            return _as_call(target, method, told[method])
        calls = [*(call for task in self.recording.tasks for call in task.calls), *self.recording.others]
        same = [call for call in calls if (call.object, call.method) == (target, method) and call.error is None]
        if same:
            return same[0]
        if method == "now_s":
            return _as_call(target, method, calls[0].time_s if calls else 0.0)
        raise NotRecorded(
            f"{self.recording.path} has no answer for {target}.{method}", hint="record it while somebody asks for it"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pages:
    """What one task has not asked yet, by object; looks by object and method, with the newest one given."""

    task: RecordedTask
    strict: dict[str, deque[RecordedCall]]
    looks: dict[tuple[str, str], deque[RecordedCall]]
    given: dict[tuple[str, str], RecordedCall]

    @classmethod
    def of(cls, task: RecordedTask) -> _Pages:
        strict: dict[str, deque[RecordedCall]] = {}
        looks: dict[tuple[str, str], deque[RecordedCall]] = {}
        for call in task.calls:
            if call.method in LOOKS:
                looks.setdefault((call.object, call.method), deque()).append(call)
            elif call.method not in NOTHING_TO_DO:
                strict.setdefault(call.object, deque()).append(call)
        return cls(task=task, strict=strict, looks=looks, given={})

    def look(self, target: str, method: str) -> RecordedCall | None:
        """Return the next recorded look if it was made before the next other call, else the one before again."""
        waiting = self.looks.get((target, method))
        if not waiting:
            return self.given.get((target, method))
        next_number = min((calls[0].number for calls in self.strict.values() if calls), default=None)
        before = self.given.get((target, method))
        if before is None or next_number is None or waiting[0].number < next_number:
            before = self.given[target, method] = waiting.popleft()
        return before


def distance(recorded: Any, asked: Any) -> float | None:
    """Return how far apart two motions end, in units of what counts as near; None for motions of different kinds."""
    if type(recorded) is not type(asked) or recorded.name != asked.name:
        return None
    match recorded:
        case JointTrajectory():
            apart = np.abs(recorded.positions_rad[-1] - asked.positions_rad[-1])
            return float(np.max(apart)) / NEAR_RAD
        case CartesianPath():
            turn = recorded.base_from_tool[-1].inv() * asked.base_from_tool[-1]
            far_m = float(np.linalg.norm(turn.translation))
            return max(far_m / NEAR_M, float(turn.rotation.magnitude()) / NEAR_RAD)
        case GripperMotion():
            return float(abs(recorded.width_m - asked.width_m)) / NEAR_M
    return 0.0


def _name(asked: list[Any]) -> str:
    return f"motion {asked[0].name!r}" if asked and hasattr(asked[0], "name") else "an argument"


def _as_call(target: str, method: str, value: Any) -> RecordedCall:
    return RecordedCall(
        number=-1, object=target, method=method, arguments=[], keywords={}, value=value, error=None, time_s=0.0
    )


class ReplayedObject:
    """A recorded device, mover or clock."""

    def __init__(self, book: Book, name: str, methods: frozenset[str], constants: dict[str, Any]) -> None:
        self._book = book
        self._name = name
        self._methods = methods
        self.__dict__.update(constants)

    def __getattr__(self, method: str) -> Callable[..., Any]:
        if method.startswith("_") or method not in self._methods:
            raise AttributeError(method)
        if method in NOTHING_TO_DO:
            return lambda *_args, **_kwargs: None
        return lambda *args, **kwargs: self._book.answer(self._name, method, args, kwargs)

    def __dir__(self) -> list[str]:
        return sorted({*self._methods, *(name for name in self.__dict__ if not name.startswith("_"))})


class _NoSwap:
    """Refuses to exchange devices."""

    def swap(self, name: str, *_args: Any, **_kwargs: Any) -> None:
        """Raise `Unsupported`."""
        raise Unsupported(f"{name} is replayed from a recording", hint="start the cell itself to exchange its devices")


def replayed_cell(book: Book, cell: Cell) -> CellRuntime:
    """Return the recorded cell, running, with `book`'s answers."""
    objects: dict[str, Any] = {}
    for name, told in book.recording.objects.items():
        constants = book.recording.value(told["constants"])
        objects[name] = ReplayedObject(book, name, frozenset(told["methods"]), constants)
    objects[PREFIX + SWAPPER] = _NoSwap()
    return CellRuntime(cell=cell, clock=objects[PREFIX + CLOCK], objects=objects)
