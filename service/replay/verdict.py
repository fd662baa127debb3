"""Runs the tasks of a recording again and compares what comes out with what came out then."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from service.core import Service
from service.recording.reader import RecordedTask
from service.replay.book import LOOKS, NOTHING_TO_DO, Book
from service.tasks.model import Task

OF_THE_RUN = ("wall_s", "mission", "report")  # keys of results that name or time the run, not the cell
SHOWN = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """How the replay of one task compares with its recording.

    Attributes:
        answered: recorded calls that were asked for again, of `calls`.
        differences: where the replay differs, in words; empty when calls and result are equal to the last bit.
        complaint: why the replay is of no use from some point on; empty when it went through.
        note: what the recording itself lacks.
    """

    task: str
    verb: str
    calls: int
    answered: int
    differences: tuple[str, ...]
    complaint: str = ""
    hint: str = ""
    note: str = ""

    @property
    def same_readings(self) -> bool:
        """Whether every recorded answer was asked for again, and nothing else."""
        return not self.complaint and self.answered == self.calls

    @property
    def same_bits(self) -> bool:
        """Whether the questions and the result are equal to the last bit too."""
        return self.same_readings and not self.differences


def replay_tasks(service: Service, book: Book, *, begin: Callable[[RecordedTask], None]) -> Iterator[Verdict]:
    """Run the recorded tasks one after another on a service whose cell is replayed from `book`; yields a verdict on each.

    Args:
        begin: called before each task.

    Raises:
        InvalidRequest: this version has no such verb, or refuses the recorded request.
    """
    names: dict[str, str] = {}  # of missions and tasks, recorded and now
    for recorded in book.recording.tasks:
        begin(recorded)
        told = len(book.differences)
        book.refused = None
        task = _run(service, recorded, names)
        names[recorded.id] = task.id
        if isinstance(recorded.result, dict) and isinstance(task.result, dict) and "mission" in recorded.result:
            names[str(recorded.result["mission"])] = str(task.result.get("mission"))
        yield _compared(book, recorded, task, book.differences[told:], names)


def _run(service: Service, recorded: RecordedTask, names: dict[str, str]) -> Task:
    text = _renamed(json.dumps(recorded.request), names)
    request = service.operations[recorded.verb].request_model.model_validate_json(text)
    task = service.submit(recorded.verb, request)
    while not task.wait(1.0):
        pass
    return task


def _renamed(text: str, names: dict[str, str]) -> str:
    for before, now in names.items():
        text = text.replace(before, now)
    return text


def _compared(book: Book, recorded: RecordedTask, task: Task, differences: list[str], names: dict[str, str]) -> Verdict:
    calls = sum(call.method not in (*LOOKS, *NOTHING_TO_DO) for call in recorded.calls)
    answered = calls - book.left(recorded)
    is_whole = recorded.state in ("succeeded", "failed")
    refused = book.refused
    note = "" if is_whole else f"the recording has no end of this task ({recorded.state or 'cut off'})"
    if refused is not None and not is_whole and answered == calls:
        refused = None  # it went on beyond the end of its recording
    if is_whole:
        differences = [*differences, *differing(_plain(recorded, names), _plain(task, {}))]
    return Verdict(
        task=task.id,
        verb=recorded.verb,
        calls=calls,
        answered=answered,
        differences=tuple(differences),
        complaint="" if refused is None else refused.what,
        hint="" if refused is None else refused.hint,
        note=note,
    )


def _plain(task: RecordedTask | Task, names: dict[str, str]) -> Any:
    ended = {"state": str(task.state), "result": task.result, "problem": task.problem}
    return json.loads(_renamed(json.dumps(ended), names))


def differing(before: Any, now: Any, path: str = "") -> list[str]:
    """Return the places at which two JSON values differ, in words."""
    if isinstance(before, dict) and isinstance(now, dict):
        keys = [key for key in sorted({*before, *now}) if key not in OF_THE_RUN]
        return [
            place for key in keys for place in differing(before.get(key), now.get(key), f"{path}.{key}".lstrip("."))
        ]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [place for k, (a, b) in pairs for place in differing(a, b, f"{path}[{k}]")]
    return [] if before == now else [f"{path}: recorded {_short(before)}, now {_short(now)}"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
