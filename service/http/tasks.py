"""`/v1/tasks`: watches and cancels tasks, and fetches their files."""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator
from contextlib import AbstractContextManager
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Query
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.responses import FileResponse

from service.access.actor import actor
from service.http.access import StillMay
from service.http.models import TaskList, TaskView, event_data
from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, LeaseToken, State
from service.http.verbs import Wait
from service.tasks.model import Task, TaskState

router = APIRouter(prefix="/v1/tasks", tags=["tasks"], responses=RESPONSES)
TaskId = Annotated[str, Path(max_length=64, examples=["3f9c2a7be01d4c55"])]


@router.get("", summary="Kept tasks, newest first", operation_id="list_tasks")
async def list_tasks(
    state: State,
    task_state: Annotated[TaskState | None, Query(alias="state")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> TaskList:
    tasks = [task for task in state.service.tasks.all() if task_state in (None, task.state)]
    return TaskList(tasks=[TaskView.of(task) for task in tasks[:limit]])


@router.get("/{task_id}", summary="One task", operation_id="show_task")
async def show_task(state: State, task_id: TaskId, wait_s: Wait = 0.0) -> TaskView:
    task = state.service.tasks.get(task_id)
    with _followed(state, task):
        if wait_s > 0.0:
            await state.hub.wait_for(task, wait_s)
    return TaskView.of(task)


@router.post("/{task_id}/cancel", summary="Stop the arm, then end the task", operation_id="cancel_task")
async def cancel_task(state: State, task_id: TaskId, lease_token: LeaseToken = None, wait_s: Wait = 0.0) -> TaskView:
    """Anybody may cancel, because ending a motion is always allowed. Returns the task as it is after `wait_s`."""
    del lease_token  # accepted, so that clients may send it with every request
    task = await state.act(functools.partial(state.service.tasks.cancel, task_id, reason="requested over HTTP"))
    if wait_s > 0.0:
        await state.hub.wait_for(task, wait_s)
    return TaskView.of(task)


@router.post("/{task_id}/pause", summary="Stand still before the next step of a mission", operation_id="pause_task")
async def pause_task(state: State, holder: Admitted, task_id: TaskId) -> TaskView:
    """The task keeps its right to move, and the arm stands still until `go-on`; the journal says who asked."""
    del holder
    return TaskView.of(await state.act(functools.partial(state.service.tasks.pause, task_id)))


@router.post("/{task_id}/go-on", summary="Let a paused mission go on", operation_id="let_task_go_on")
async def let_task_go_on(state: State, holder: Admitted, task_id: TaskId) -> TaskView:
    del holder
    return TaskView.of(await state.act(functools.partial(state.service.tasks.go_on, task_id)))


def _followed(state: AppState, task: Task) -> AbstractContextManager[None]:
    """Keep a motion that has no lease of a client, as long as somebody with the key that asked for it follows it."""
    return state.service.lease.subs.kept(task.sub_lease if task.by == actor() else None)


async def _watched(state: State, task_id: TaskId) -> Task:
    """Return the task, looked up before the stream begins, so that an unknown id is a 404 and not an empty stream."""
    return state.service.tasks.get(task_id)


@router.get(
    "/{task_id}/events",
    summary="Progress as server-sent events; resume with Last-Event-ID",
    operation_id="watch_task",
    response_class=EventSourceResponse,
    response_description="one event per change: `id` counts up, `event` is state, progress or artefact, `data` is JSON; the "
    "stream ends with the task",
)
async def watch_task(
    state: State,
    task: Annotated[Task, Depends(_watched)],
    may: StillMay,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", max_length=20)] = None,
) -> AsyncIterator[ServerSentEvent]:
    seen = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else 0
    with state.hub.watch() as changed, _followed(state, task):
        while True:
            changed.clear()
            is_over = task.state.is_final or state.hub.is_closing  # read before the events, so that none is missed
            if not may():
                return
            for event in task.events_after(seen):
                seen = event.sequence
                yield ServerSentEvent(id=str(seen), event=event.kind, data=event_data(event))
            if is_over:
                return
            await changed.wait()


@router.get(
    "/{task_id}/artefacts/{name}",
    summary="A file that the task produced",
    operation_id="fetch_artefact",
    response_class=FileResponse,
    responses={200: {"content": {"application/octet-stream": {}}}},
)
async def fetch_artefact(state: State, task_id: TaskId, name: Annotated[str, Path(max_length=100)]) -> FileResponse:
    path, artefact = state.service.tasks.artefact_path(task_id, name)
    return FileResponse(path, media_type=artefact.media_type, filename=name, content_disposition_type="inline")
