"""Restores the tasks of earlier runs of the service from the journal."""

from __future__ import annotations

from typing import Any

from service.tasks.journal import Journal
from service.tasks.model import Artefact, Task, TaskState

KEPT = 100
KINDS = ("task-queued", "task-started", "task-ended")


def tasks_of_earlier_runs(journal: Journal) -> list[Task]:
    """Return the newest tasks in the journal, oldest first; one that has no end was running when the service ended."""
    tasks: dict[str, Task] = {}
    for record in journal.records(kinds=KINDS, limit=len(KINDS) * KEPT):
        data = record.data
        if record.kind == "task-queued":
            tasks[data["task"]] = Task(
                id=data["task"],
                verb=data["verb"],
                request=data["request"],
                moves=True,
                holder=data["holder"],
                key=data.get("key"),
                created_s=record.wall_time_s,
            )
        elif data["task"] not in tasks:
            continue
        elif record.kind == "task-started":
            tasks[data["task"]].state, tasks[data["task"]].started_s = TaskState.RUNNING, record.wall_time_s
        else:
            _bring_to_end(tasks[data["task"]], data, record.wall_time_s)
    return list(tasks.values())


def _bring_to_end(task: Task, data: dict[str, Any], ended_s: float) -> None:
    """Set state and result of a restored task from its last record."""
    task.result, task.problem = data["result"], data["problem"]
    task.artefacts = [Artefact(**item) for item in data["artefacts"]]
    task.started_s, task.ended_s = data.get("started_s"), ended_s
    task.state = TaskState(data["state"])
    fraction = 1.0 if task.state is TaskState.SUCCEEDED else float(data.get("fraction", 0.0))
    task.add_event("state", fraction=fraction, step=str(data.get("step", "")))
