"""`/v1/alarms`: the alarms of the panel's objects, and what people do with them (ISA-18.2)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Path, Query
from fastapi import Depends as DependsOn
from pydantic import BaseModel, Field

from hal.strict import Strict
from service.alarms.lifecycle import SUPPRESSED, Alarm, State
from service.http.body import body_schema, strict_body
from service.http.models import Holder
from service.http.problems import RESPONSES
from service.http.state import AppState
from service.http.state import State as Shared

router = APIRouter(prefix="/v1/alarms", tags=["alarms"], responses=RESPONSES)
AlarmId = Annotated[
    str, Path(pattern=r"^[a-z][a-z0-9_]{0,40}\.[a-z_]{1,20}$", examples=["pressure.high"], description="object.kind")
]
Reason = Annotated[str, Field(max_length=500)]
GivenReason = Annotated[str, Field(min_length=1, max_length=500)]
PRIORITIES = ("urgent", "high", "medium", "low")


class AlarmView(BaseModel):
    """An alarm. `is_active` says whether its condition holds, whatever its state.

    `by` is who changed the state last, or commented on it.

    `straddles`: the interval of the value reaches over the limit, so that the condition is not certain.
    """

    id: str
    object: str
    kind: str
    state: State
    is_active: bool
    priority: str
    says: str
    what_to_do: str
    straddles: bool
    raised_s: Annotated[float | None, Field(description="seconds since 1970")]
    changed_s: float
    by: str
    key_name: Annotated[
        str | None, Field(description="the key that authorised that; null without keys, and for the cell")
    ]
    reason: str
    shelved_until_s: float | None


class DoubtView(BaseModel):
    """A limit that the newest interval of a value straddles, although there is no alarm."""

    alarm: str
    says: str


class AlarmList(BaseModel):
    """Alarms that are not normal, those that need a person first, then by priority; and limits that a value straddles."""

    alarms: list[AlarmView]
    straddled: list[DoubtView]


class AcknowledgeRequest(Strict):
    """Who has seen the alarm, and what they say about it."""

    by: Holder
    reason: Reason = ""


class ShelveRequest(Strict):
    """Who shelves the alarm, until when, and why."""

    by: Holder
    until_s: Annotated[float, Field(ge=0.0, le=1e11, description="seconds since 1970, at most 31 days ahead")]
    reason: GivenReason


class ServiceRequest(Strict):
    """Who takes the alarm out of service, and why; or who comments on it, and how."""

    by: Holder
    reason: GivenReason


BODIES = (AcknowledgeRequest, ShelveRequest, ServiceRequest)
Acknowledge = Annotated[AcknowledgeRequest, DependsOn(strict_body(AcknowledgeRequest))]
Shelve = Annotated[ShelveRequest, DependsOn(strict_body(ShelveRequest))]
OutOfService = Annotated[ServiceRequest, DependsOn(strict_body(ServiceRequest))]
BY = {"by": "alice@console-2"}
WHY = {**BY, "reason": "the gauge is being replaced"}


@router.get("", summary="Alarms, those that need a person first", operation_id="list_alarms")
async def list_alarms(
    state: Shared, all: Annotated[bool, Query(description="also alarms that are normal")] = False
) -> AlarmList:
    desk = state.service.plant.alarms
    shown = [alarm for alarm in desk.all() if all or alarm.state is not State.NORMAL]
    views = [_view(state, alarm) for alarm in sorted(shown, key=functools.partial(_rank, state))]
    return AlarmList(alarms=views, straddled=[DoubtView(alarm=k, says=told) for k, told in desk.doubts().items()])


@router.post(
    "/{alarm}/acknowledge",
    summary="Say that a person has seen it",
    operation_id="acknowledge_alarm",
    openapi_extra=body_schema(AcknowledgeRequest, BY, required=True),
)
async def acknowledge_alarm(state: Shared, alarm: AlarmId, request: Acknowledge) -> AlarmView:
    desk = state.service.plant.alarms
    return await _done(state, functools.partial(desk.acknowledge, alarm, by=request.by, reason=request.reason))


@router.post(
    "/{alarm}/shelve",
    summary="Shelve it until a time",
    operation_id="shelve_alarm",
    openapi_extra=body_schema(ShelveRequest, {**WHY, "until_s": 1.8e9}, required=True),
)
async def shelve_alarm(state: Shared, alarm: AlarmId, request: Shelve) -> AlarmView:
    given = request.model_dump()
    return await _done(state, functools.partial(state.service.plant.alarms.shelve, alarm, **given))


@router.post(
    "/{alarm}/unshelve",
    summary="End its shelving",
    operation_id="unshelve_alarm",
    openapi_extra=body_schema(AcknowledgeRequest, BY, required=True),
)
async def unshelve_alarm(state: Shared, alarm: AlarmId, request: Acknowledge) -> AlarmView:
    return await _done(state, functools.partial(state.service.plant.alarms.unshelve, alarm, **request.model_dump()))


@router.post(
    "/{alarm}/out-of-service",
    summary="Take it out of service",
    operation_id="take_alarm_out_of_service",
    openapi_extra=body_schema(ServiceRequest, WHY, required=True),
)
async def take_alarm_out_of_service(state: Shared, alarm: AlarmId, request: OutOfService) -> AlarmView:
    given = request.model_dump()
    return await _done(state, functools.partial(state.service.plant.alarms.take_out_of_service, alarm, **given))


@router.post(
    "/{alarm}/in-service",
    summary="Put it back in service",
    operation_id="put_alarm_in_service",
    openapi_extra=body_schema(AcknowledgeRequest, BY, required=True),
)
async def put_alarm_in_service(state: Shared, alarm: AlarmId, request: Acknowledge) -> AlarmView:
    return await _done(
        state, functools.partial(state.service.plant.alarms.put_in_service, alarm, **request.model_dump())
    )


@router.post(
    "/{alarm}/comment",
    summary="Comment on it; its state stays",
    operation_id="comment_alarm",
    openapi_extra=body_schema(ServiceRequest, WHY, required=True),
)
async def comment_alarm(state: Shared, alarm: AlarmId, request: OutOfService) -> AlarmView:
    desk = state.service.plant.alarms
    return await _done(state, functools.partial(desk.comment, alarm, by=request.by, reason=request.reason))


async def _done(state: AppState, deed: Callable[[], Alarm]) -> AlarmView:
    return _view(state, await state.act(deed))


def _rank(state: AppState, alarm: Alarm) -> tuple[bool, int, bool, float]:
    needs_nobody = alarm.state in (State.NORMAL, State.ACKNOWLEDGED, *SUPPRESSED)
    priority = state.service.cell.panel.object(alarm.object).priority
    return needs_nobody, PRIORITIES.index(priority), not alarm.is_active, -alarm.changed_s


def _view(state: AppState, alarm: Alarm) -> AlarmView:
    one = state.service.cell.panel.object(alarm.object)
    return AlarmView(id=alarm.id, priority=one.priority, what_to_do=one.what_to_do, **asdict(alarm))
