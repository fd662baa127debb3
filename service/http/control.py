"""`/v1/lease` and `/v1/stop`: the right to move the arm, and the software stop (not a safety function)."""

from __future__ import annotations

import asyncio
import functools
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request
from fastapi import Depends as DependsOn

from hal.clock import Deadline, WallClock
from hal.errors import CellError, Unsupported
from service.errors import Busy
from service.http.body import body_schema, strict_body
from service.http.models import GrantView, LeaseRequest, LeaseView, ResetRequest, SpeedView, StopView, TakeOverRequest
from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, State
from service.processes.connection import CellConnection
from service.processes.latch import LatchState
from service.processes.stop import level_of
from service.tasks.lease import Grant

router = APIRouter(prefix="/v1", responses=RESPONSES)
TELL_S = 0.5  # an answer about the stop waits no longer for the cell
Level = Annotated[str, Query(description="`hold` leaves the drives on; anything else switches them off")]
OwnToken = Annotated[str, Header(alias="Lease-Token", max_length=200, description="token from POST /v1/lease")]
TakeOverBody = Annotated[TakeOverRequest, DependsOn(strict_body(TakeOverRequest))]
HolderBody = Annotated[LeaseRequest, DependsOn(strict_body(LeaseRequest))]
TAKE_OVER_SCHEMA = body_schema(
    TakeOverRequest, {"holder": "alice@console-2", "reason": "bob has gone home"}, required=True
)
HOLDER_SCHEMA = body_schema(LeaseRequest, {"holder": "alice@console-2"}, required=True)


@router.get("/lease", summary="Who may move", operation_id="show_lease", tags=["lease"])
async def show_lease(state: State) -> LeaseView:
    return _lease(state)


@router.post(
    "/lease", summary="Take the free lease", operation_id="acquire_lease", tags=["lease"], openapi_extra=HOLDER_SCHEMA
)
async def acquire_lease(state: State, request: HolderBody) -> GrantView:
    return _grant(state, await state.act(functools.partial(state.service.lease.acquire, request.holder)))


@router.post("/lease/heartbeat", summary="Renew the lease", operation_id="renew_lease", tags=["lease"])
async def renew_lease(state: State, lease_token: OwnToken) -> GrantView:
    return _grant(state, state.service.lease.heartbeat(lease_token))


@router.post("/lease/release", summary="Give the lease back", operation_id="release_lease", tags=["lease"])
async def release_lease(state: State, lease_token: OwnToken) -> LeaseView:
    await state.act(functools.partial(state.service.lease.release, lease_token))
    return _lease(state)


@router.post(
    "/lease/take-over",
    summary="Take the lease from its holder; the tasks of that holder are stopped",
    operation_id="take_over_lease",
    tags=["lease"],
    openapi_extra=TAKE_OVER_SCHEMA,
)
async def take_over_lease(state: State, request: TakeOverBody) -> GrantView:
    take_over = functools.partial(state.service.lease.take_over, request.holder, reason=request.reason)
    return _grant(state, await state.act(take_over))


@router.get("/stop", summary="State of the software stop", operation_id="show_stop", tags=["stop"])
async def show_stop(state: State) -> StopView:
    return await _stop(state, state.service.supervisor.latch.state())


@router.post(
    "/stop", summary="Stop the arm; anybody may do this at any time, without a body", operation_id="stop", tags=["stop"]
)
async def stop(state: State, request: Request, level: Level = "off") -> StopView:
    """Latch the software stop.

    When the arm is at rest, its drives are switched off; with `level=hold` they stay on and hold it. The same request to the
    stop process (`stop_url`) is faster, and works even if this service hangs.
    """
    peer = request.client.host if request.client is not None else "local"
    source, wanted = f"POST /v1/stop from {peer}", level_of(level)
    return await _stop(state, await state.stop(lambda: state.service.supervisor.stop(source, wanted)))


@router.post(
    "/stop/reset",
    summary="Clear the stop; this alone moves nothing",
    operation_id="reset_stop",
    tags=["stop"],
    openapi_extra=body_schema(ResetRequest, {"seen_count": 3}),
)
async def reset_stop(
    state: State, holder: Admitted, request: Annotated[ResetRequest, DependsOn(strict_body(ResetRequest))]
) -> StopView:
    source = f"POST /v1/stop/reset by {holder or 'a client without a lease'}"
    reset = functools.partial(state.service.supervisor.reset, source, seen_count=request.seen_count)
    return await _stop(state, await state.act(reset))


@router.get("/speed", summary="The speed limit that holds now", operation_id="show_speed", tags=["stop"])
async def show_speed(state: State) -> SpeedView:
    return _speed(state)


@router.post(
    "/speed/reduce",
    summary="Make the arm slow while people are near; anybody may do this at any time",
    operation_id="reduce_speed",
    tags=["stop"],
)
async def reduce_speed(state: State, request: Request) -> SpeedView:
    """Let `safety.reduced_speed_m_per_s` hold, also in the running motion, until somebody restores the speed."""
    peer = request.client.host if request.client is not None else "local"
    await state.stop(lambda: state.service.speed.reduce(f"POST /v1/speed/reduce from {peer}"))
    return _speed(state)


@router.post(
    "/speed/restore",
    summary="Let the speed of the cell hold again, when nobody is near",
    operation_id="restore_speed",
    tags=["stop"],
)
async def restore_speed(state: State, holder: Admitted) -> SpeedView:
    source = f"POST /v1/speed/restore by {holder or 'a client without a lease'}"
    await state.act(lambda: state.service.speed.restore(source))
    return _speed(state)


def _speed(state: AppState) -> SpeedView:
    safety, is_reduced = state.service.cell.file.safety, state.service.speed.is_reduced
    most = min(safety.speed_limit_m_per_s, safety.reduced_speed_m_per_s) if is_reduced else safety.speed_limit_m_per_s
    return SpeedView(is_reduced=is_reduced, limit_m_per_s=most)


def _lease(state: AppState) -> LeaseView:
    holder, epoch, left_s = state.service.lease.holder()
    return LeaseView(
        is_held=holder is not None,
        holder=holder,
        epoch=epoch,
        ttl_s=state.service.lease.ttl_s,
        remaining_s=left_s,
        sequence=state.service.lease.newest_sequence(),
        clock_s=state.service.lease.clock_s(),
    )


def _grant(state: AppState, grant: Grant) -> GrantView:
    return GrantView(**{**_lease(state).model_dump(), **asdict(grant), "is_held": True})


def _not_stopped(connection: CellConnection) -> tuple[str, ...]:
    """Return the devices that did not obey the newest stop of a motion; a cell that cannot tell is named itself."""
    try:
        port: Any = connection.mover
        return tuple(port.not_stopped(deadline=Deadline.after(WallClock(), TELL_S)))
    except Unsupported:  # a cell without an arm
        return ()
    except CellError as error:
        return (f"cell: {error.what}",)


async def _stop(state: AppState, latch: LatchState) -> StopView:
    """Return the state of the stop, and while it is latched what did not obey it."""
    not_stopped: tuple[str, ...] = ()
    if latch.is_latched:
        try:
            async with asyncio.timeout(TELL_S):
                not_stopped = await state.in_thread(lambda: _not_stopped(state.service.supervisor.connection))
        except (TimeoutError, Busy):
            not_stopped = ("cell: it does not answer, so that what obeys the stop is not known",)
    return StopView(
        is_latched=latch.is_latched,
        count=latch.count,
        changed_time_s=latch.time_s,
        source=latch.source,
        level=latch.level,
        not_stopped=list(not_stopped),
        stop_url=state.stop_url,
    )
