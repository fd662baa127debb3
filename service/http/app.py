"""Builds the HTTP application from routers, guard, problem handlers, API document and web page."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, JSONResponse
from starlette.types import ASGIApp

from service.core import Service
from service.http import (
    alarms,
    calibrations,
    control,
    devices,
    feed,
    frames,
    health,
    history,
    images,
    knowledge,
    limits,
    mission_files,
    missions,
    photographs,
    review,
    rounds,
    session,
    stream,
    tasks,
    verbs,
)
from service.http.access import check_access
from service.http.feed_desk import FeedDesk
from service.http.guard import Allowed, RequestGuard
from service.http.health import SAFETY_NOTE, own_version
from service.http.hub import Hub
from service.http.load import Load
from service.http.metrics import Metrics
from service.http.models import FaultRequest, LeaseRequest, ResetRequest, SwapRequest, TakeOverRequest
from service.http.page import Page
from service.http.problems import Problem, install
from service.http.query import check_query
from service.http.session import LoginRequest
from service.http.state import AppState
from service.knowledge.teach import OutlineRequest, TeachRequest
from service.readings import ReadingDesk
from service.schema.requests import ReadPhotographRequest

WEB = Path(__file__).parents[1] / "web"
DESCRIPTION = f"""
A robot cell that inspects and operates an industrial control panel.

Long work runs as a task: the verbs answer 202 with `Location: /v1/tasks/{{id}}`, or 200 if the task ends within `wait_s`.
Errors are RFC 9457 problems with `hint` and `retry`. Lengths are metres, angles radians, forces newtons.
Poses are named `parent_from_child`; covariances are 6x6 over (dx, dy, dz, rx, ry, rz) in the parent's axes.

**{SAFETY_NOTE}**
"""


def create_app(
    service: Service,
    *,
    allowed: Allowed,
    stop_url: str,
    cookie: str = "panelwright",
    console_url: str | None = None,
    console_secret: str | None = None,
    is_loaded: Callable[[], bool] = lambda: True,
) -> ASGIApp:
    """Return the ASGI application of a service, which may still be starting.

    Args:
        allowed: hosts and origins that may use it.
        stop_url: address of the stop process, which is shown to clients.
        cookie: name of the cookie of a browser's session.
        console_url: address of the console, likewise; None without one.
        console_secret: by which a request of the console is recognised.
        is_loaded: whether the modules that compute are imported; requests that may need them wait for that.
    """
    state = AppState(
        service=service,
        stop_url=stop_url,
        origins=allowed.origins,
        cookie=cookie,
        console_url=console_url,
        console_secret=console_secret,
        hub=Hub(),
        metrics=Metrics(service),
        readings=ReadingDesk(lambda: service.supervisor.connection),
    )
    app = FastAPI(
        title="panelwright",
        version=own_version(),
        description=DESCRIPTION,
        docs_url=None,  # FastAPI's pages load scripts from other hosts
        redoc_url=None,
        openapi_url=None,  # a route of our own, so that it needs a key as every call does
        dependencies=[Depends(_check)],
        lifespan=_lifespan,
    )
    app.state.panelwright = state
    app.state.sampler = stream.Sampler(state)
    app.state.feed = FeedDesk()
    routers = _routers(service)
    for router in routers:
        app.include_router(router)
    app.add_api_route("/openapi.json", _api_document, include_in_schema=False)
    app.add_api_route("/docs", _docs_page, include_in_schema=False)
    install(app, paths=[getattr(route, "path", "") for router in routers for route in router.routes])
    app.mount("/", Page(WEB, app.routes), name="page")
    bodies = [operation.request_model for operation in service.operations.values()]
    app.openapi = lambda: _document(app, bodies)  # type: ignore[method-assign]  # the documented way to extend it
    return RequestGuard(app, allowed=allowed, count=state.metrics.count_answer, is_loaded=is_loaded)


def _routers(service: Service) -> tuple[APIRouter, ...]:
    """Return the routers; each request asks them in turn, so that those of frequent small requests come first."""
    return (
        control.router,
        health.router,
        verbs.router(dict(service.operations)),
        tasks.router,
        devices.router,
        knowledge.router,
        images.router,
        photographs.router,
        frames.router,
        calibrations.router,
        mission_files.router,
        missions.router,
        history.router,
        feed.router,
        alarms.router,
        limits.router,
        rounds.router,
        review.router,
        session.router,
        stream.router,
    )


def state_of_app(guarded: ASGIApp) -> AppState:
    """Return the state of an application that `create_app` made."""
    assert isinstance(guarded, RequestGuard)  # noqa: S101 - narrowing: `create_app` returns a RequestGuard
    state: AppState = guarded.inner.state.panelwright
    return state


def load_of_app(guarded: ASGIApp) -> Load:
    """Return the limits of an application that `create_app` made."""
    assert isinstance(guarded, RequestGuard)  # noqa: S101 - narrowing: `create_app` returns a RequestGuard
    return guarded.load


def document_of_app(guarded: ASGIApp) -> dict[str, Any]:
    """Return the API document of an application that `create_app` made."""
    assert isinstance(guarded, RequestGuard)  # noqa: S101 - narrowing: `create_app` returns a RequestGuard
    document: dict[str, Any] = guarded.inner.openapi()
    return document


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    state: AppState = app.state.panelwright
    state.hub.open(state.service.tasks)
    app.state.feed.open(state.hub, state.service.plant)
    probe = asyncio.create_task(state.metrics.probe_lag())
    yield
    probe.cancel()
    state.hub.close()
    app.state.feed.release()
    for pool in (state.pool, state.control_pool, state.stop_pool):
        pool.shutdown(wait=False, cancel_futures=True)


async def _check(connection: HTTPConnection) -> None:
    """Check key, role and query of every request; one dependency, because each costs 20 us."""
    await check_access(connection)
    await check_query(connection)


async def _docs_page() -> FileResponse:
    return FileResponse(WEB / "docs.html")


async def _api_document(request: Request) -> JSONResponse:
    return JSONResponse(request.app.openapi())


def _document(app: FastAPI, bodies: list[type[BaseModel]]) -> dict[str, Any]:
    """Return the API document, with the schemas of the bodies that strict readers parse."""
    if app.openapi_schema:
        return app.openapi_schema
    document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    models: list[type[BaseModel]] = [
        *dict.fromkeys(bodies),
        FaultRequest,
        LeaseRequest,
        LoginRequest,
        ResetRequest,
        SwapRequest,
        TakeOverRequest,
        OutlineRequest,
        ReadPhotographRequest,
        TeachRequest,
        *alarms.BODIES,
        *limits.BODIES,
        *mission_files.BODIES,
        *rounds.BODIES,
        *review.BODIES,
        Problem,
    ]
    _, extra = models_json_schema(
        [(model, "validation") for model in models], ref_template="#/components/schemas/{model}"
    )
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for name, schema in extra.get("$defs", {}).items():
        schemas.setdefault(name, schema)
    _drop_unused_validation(document)
    app.openapi_schema = document
    return document


def _drop_unused_validation(document: dict[str, Any]) -> None:
    """Remove FastAPI's own 422 body from the document, because it is never sent."""
    for path in document["paths"].values():
        for operation in path.values():
            operation.get("responses", {}).pop("422", None)
    for name in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(name, None)
