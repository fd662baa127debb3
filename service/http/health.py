"""`/healthz`, `/readyz`, `/metrics` and `/v1/info`, which answer before the hardware is ready."""

from __future__ import annotations

import time
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version

from fastapi import APIRouter
from starlette.responses import JSONResponse, Response

from service.http.models import HealthzView, InfoView, MissingView, ProcessView, ReadyView
from service.http.problems import RESPONSES
from service.http.state import State

router = APIRouter(tags=["health"], responses=RESPONSES)
SAFETY_NOTE = "The software stop is not a safety function; an external hardware stop is required."


@router.get("/healthz", summary="Whether the service answers", operation_id="healthz")
async def healthz() -> HealthzView:
    return HealthzView()


@router.get(
    "/readyz",
    summary="Whether the cell is ready, and for what",
    operation_id="readyz",
    responses={503: {"description": "the cell is not running", "model": ReadyView}},
    response_model=ReadyView,
)
async def readyz(state: State) -> JSONResponse:
    service = state.service
    supervisor, processes = service.supervisor, service.supervisor.processes()
    is_running = supervisor.is_ready and all(process.is_alive for process in processes)
    missing = [MissingView(**asdict(one), lost=list(service.lost_without(one.device))) for one in supervisor.missing]
    view = ReadyView(
        is_ready=is_running and not missing and service.journal_watch.problem is None,
        is_running=is_running,
        missing=missing,
        lacking={verb: list(devices) for verb, devices in service.lacking().items()},
        journal_problem=service.journal_watch.problem,
        processes=[ProcessView(**asdict(process)) for process in processes],
    )
    return JSONResponse(view.model_dump(mode="json"), 200 if is_running else 503)


@router.get(
    "/metrics",
    summary="Prometheus metrics",
    operation_id="metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(state: State) -> Response:
    return Response(state.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/v1/info", summary="What this is", operation_id="info")
async def info(state: State) -> InfoView:
    file = state.service.cell.file
    return InfoView(
        name="panelwright",
        version=own_version(),
        cell=file.cell.name,
        mode=file.cell.mode,
        panel=state.service.cell.panel.name,
        seed=file.cell.seed,
        verbs=list(state.service.operations),
        stop_url=state.stop_url,
        console_url=state.console_url,
        uptime_s=time.monotonic() - state.started_s,
        event_loop_lag_p99_s=state.metrics.lag_p99_s(),
        safety_note=SAFETY_NOTE,
        access="open" if state.service.keys.is_open else "keys",
    )


def own_version() -> str:
    """Return the installed version, or `unknown` if the package is not installed."""
    try:
        return version("panelwright")
    except PackageNotFoundError:
        return "unknown"
