"""`GET /v1/feed`: the readings and the changes of alarms of the whole cell, in order, for programs that follow them."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service.http.history import HistoryReading, reading_view
from service.http.problems import RESPONSES
from service.http.state import AppState, State

router = APIRouter(prefix="/v1/feed", tags=["history"], responses=RESPONSES)
After = Annotated[
    int | None, Query(ge=0, lt=2**62, description="newest that is known; without it, only what comes from now on")
]
LOOK_S = 0.02
BATCH = 200


class AlarmChange(BaseModel):
    """A change of an alarm: its state after it. `number` rises with each change of the cell's alarms."""

    number: int
    id: str
    object: str
    kind: str
    before: str
    state: str
    is_active: bool
    says: str
    changed_s: Annotated[float, Field(description="seconds since 1970")]
    by: str
    key_name: str | None
    reason: str


class Feed(BaseModel):
    """What has come after, oldest first, and what to ask after the next time."""

    readings: list[HistoryReading]
    alarms: list[AlarmChange]
    readings_after: int
    alarms_after: int


@router.get("", summary="Readings and changes of alarms since the last call", operation_id="follow_feed")
async def follow_feed(
    state: State,
    readings_after: After = None,
    alarms_after: After = None,
    wait_s: Annotated[
        float, Query(ge=0.0, le=30.0, allow_inf_nan=False, description="wait so long for something")
    ] = 0.0,
) -> Feed:
    plant, loop = state.service.plant, asyncio.get_running_loop()
    end_s = loop.time() + wait_s
    while True:
        seen = plant.changes
        found = await state.in_thread(lambda: _found(state, readings_after, alarms_after))
        if found.readings or found.alarms or readings_after is None or alarms_after is None:
            return found
        while plant.changes == seen and not state.hub.is_closing:
            if loop.time() >= end_s:
                return found
            await asyncio.sleep(LOOK_S)
        if state.hub.is_closing:
            return found


def _found(state: AppState, readings_after: int | None, alarms_after: int | None) -> Feed:
    plant = state.service.plant
    newest = plant.history.reader().newest_id()
    after = newest if readings_after is None else min(readings_after, newest)  # a history that was begun anew
    rows = plant.history.reader().page(plant.history.ask(), after=after, limit=BATCH) if after < newest else []
    changes = [] if alarms_after is None else plant.alarm_changes(alarms_after)
    return Feed(
        readings=[reading_view(row) for row in rows],
        alarms=[AlarmChange(**change) for change in changes],
        readings_after=rows[-1].id if rows else after,
        alarms_after=changes[-1]["number"]
        if changes
        else plant.alarms.number
        if alarms_after is None
        else alarms_after,
    )
