"""Judges a round by what the journal, the log, the processes and the watched arm say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hal.errors import CellError
from service.chaos.acks import Acks, journal_of
from service.chaos.options import Round
from service.chaos.plant import Plant
from service.chaos.watch import Watch, motions_while_latched
from service.tasks.journal_reader import verify_chain

DEFECTS = ("urn:panelwright:defect", "urn:panelwright:internal-error")
TRACEBACK = "Traceback (most recent call last)"


class Judge:
    """Looks at a plant from outside; each breach is told once."""

    def __init__(self, plant: Plant, acks: Acks, watch: Watch) -> None:
        self._plant = plant
        self._acks = acks
        self._watch = watch
        self._lines_seen = 0

    def of_task(self, done: Round, task_id: str) -> None:
        """Note how the task of a round ended, and whether a failure is named."""
        task = self._plant.state_of(task_id)
        if task is None:
            done.ended = "unknown"
            done.breaches.append(f"ack lost: nobody knows task {task_id}")
            return
        problem: dict[str, Any] = task.get("problem") or {}
        done.ended = " ".join(filter(None, [task["state"], str(problem.get("type", "")).rpartition(":")[2]]))
        if task["state"] == "failed":
            done.breaches += unnamed(problem)

    def of_round(self) -> list[str]:
        """Return the breaches that arm, log and journal show since the last call."""
        return [*motions_while_latched(self._watch.take()), *self._tracebacks(), *self._of_journal()]

    def of_orphans(self) -> list[str]:
        """Return a breach if processes of earlier lives, or replaced ones, still exist."""
        left = self._plant.survivors()
        for one in left:
            self._plant.orphans.append(self._plant.seen.pop(one.pid))
        return [f"orphans: {', '.join(str(one.pid) for one in left)}"] if left else []

    def _tracebacks(self) -> list[str]:
        fresh = self._plant.lines[self._lines_seen :]
        self._lines_seen += len(fresh)
        places = [number for number, line in enumerate(fresh) if TRACEBACK in line]
        return [f"a traceback in the log: {last_line(fresh[place + 1 :])}" for place in places]

    def _of_journal(self) -> list[str]:
        try:
            verify_chain(journal_of(self._plant.runs))
            lost = self._acks.lost()
        except CellError as error:
            return [f"journal broken: {error.what}"]
        for ack in lost:
            self._acks.told.remove(ack)
        return [f"ack lost: {ack.kind} {ack.key} of life {ack.life}" for ack in lost]


def unnamed(problem: dict[str, Any]) -> list[str]:
    """Return what is missing in the problem of a failed task: it must name a cause and a remedy, and be no defect."""
    if not problem.get("detail") or not problem.get("hint"):
        return ["unnamed failure: a task failed without cause or remedy"]
    if problem.get("type") in DEFECTS:
        return [f"unnamed failure: {problem['detail']}"]
    return []


def last_line(lines: Sequence[str]) -> str:
    """Return the line that names the error of a traceback: the first one behind it that is not indented."""
    return next((line.strip() for line in lines if line.strip() and not line.startswith((" ", "\t"))), "cut off")
