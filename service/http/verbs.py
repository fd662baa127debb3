"""`POST /v1/<verb>`: starts an operation as a task, and waits for its end if requested."""

from __future__ import annotations

import asyncio
import functools
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response, params
from fastapi import Depends as DependsOn
from starlette.responses import JSONResponse

from service.http.body import body_schema, strict_body
from service.http.models import TaskView, task_view
from service.http.problems import MEDIA, RESPONSES
from service.http.state import AppState, IdempotencyKey, State, WithCommand
from service.operations import Operation
from service.tasks.model import Task, TaskState

Wait = Annotated[
    float,
    Query(
        ge=0.0,
        le=30.0,
        allow_inf_nan=False,
        description="wait at most this long for the end of the task before answering",
    ),
]


def router(operations: dict[str, Operation]) -> APIRouter:
    """Return a router with one route per operation."""
    routes = APIRouter(tags=["verbs"], responses=RESPONSES)
    for operation in operations.values():
        _add(routes, operation)
    return routes


def _add(routes: APIRouter, operation: Operation) -> None:
    body: params.Depends = DependsOn(strict_body(operation.request_model))

    async def start(
        state: State,
        command: WithCommand,
        connection: Request,
        request: Any = body,
        wait_s: Wait = 0.0,
        idempotency_key: IdempotencyKey = None,
    ) -> Response:
        submit = functools.partial(
            state.service.submit,
            operation.name,
            request,
            command=command,
            key=idempotency_key,
            is_followed=True,
            client=connection.client.host if connection.client is not None else None,
        )
        task = await state.act(submit)
        if task.sub_lease is not None and state.is_of_console(connection):
            task.sub_lease.is_of_console = True
        if wait_s > 0.0:
            await wait_with_client(state, connection, task, wait_s)
        return answer(task)

    name = operation.name.replace("-", "_")
    view = task_view(operation.result_model)
    routes.add_api_route(
        f"/v1/{operation.name}",
        start,
        methods=["POST"],
        name=name,
        operation_id=name,
        summary=operation.summary,
        response_model=view,
        responses={
            200: {"description": "the task has ended; `result` holds the answer", "model": view},
            202: {"description": "the task is still running or queued; `Location` is its address", "model": view},
        },
        openapi_extra=body_schema(operation.request_model, operation.example),
    )


async def wait_with_client(state: AppState, connection: Request, task: Task, wait_s: float) -> None:
    """Wait for the end of a task; a motion without a lease ends when the connection of the client that asked breaks."""
    subs, sub = state.service.lease.subs, task.sub_lease
    with subs.kept(sub):
        ended = asyncio.ensure_future(state.hub.wait_for(task, wait_s))
        gone = asyncio.ensure_future(_until_gone(connection))
        try:
            await asyncio.wait({ended, gone}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            ended.cancel()
            gone.cancel()
    if not task.state.is_final and gone.done() and not gone.cancelled() and sub is not None and sub.is_own:
        reason = "its client is gone: the connection ended while it waited, and it holds no lease"
        await state.act(functools.partial(subs.lose, [sub], reason))


async def _until_gone(connection: Request) -> None:
    while (await connection.receive())["type"] != "http.disconnect":
        pass


def answer(task: Task) -> Response:
    """Return 200 with the result, 202 while the task runs, and the problem itself when it failed."""
    location = {"Location": f"/v1/tasks/{task.id}"}
    if task.state is TaskState.SUCCEEDED:
        return JSONResponse(TaskView.of(task).model_dump(mode="json"), 200, headers=location)
    if not task.state.is_final:
        return JSONResponse(TaskView.of(task).model_dump(mode="json"), 202, headers={**location, "Retry-After": "1"})
    cancelled = {"type": "urn:panelwright:cancelled", "title": "Cancelled", "status": 409}
    problem: dict[str, Any] = {**task.problem} if task.problem else cancelled
    return JSONResponse({**problem, "instance": location["Location"]}, problem["status"], location, media_type=MEDIA)
