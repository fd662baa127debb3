"""`/v1/rounds`: the missions that the service runs by itself, and how their runs went."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query
from fastapi import Depends as DependsOn
from pydantic import BaseModel, Field
from starlette.responses import Response

from hal.errors import InvalidRequest
from hal.plant import RoundSection
from service.http.body import body_schema, strict_body
from service.http.problems import RESPONSES
from service.http.state import State
from service.rounds.book import Run, RunState

router = APIRouter(prefix="/v1/rounds", tags=["rounds"], responses=RESPONSES)
RoundName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,40}$", examples=["morning"], alias="round")]
EXAMPLE = {"name": "morning", "mission": "inspect", "cron": "0 6 * * *", "zone": "Europe/Vienna"}
Given = Annotated[RoundSection, DependsOn(strict_body(RoundSection))]
BODIES = (RoundSection,)


class RunView(BaseModel):
    """A run of a round. Times are seconds since 1970; `due_s` is the time of the cron expression.

    `interrupted`: the service ended while it ran; it is not taken up again.
    """

    round: str
    due_s: float
    state: RunState
    why: str
    mission: str
    task: str | None
    begun_s: float | None
    ended_s: float | None

    @staticmethod
    def of(run: Run) -> RunView:
        """Return a run as the API shows it."""
        return RunView(**{name: getattr(run, name) for name in RunView.model_fields})


class RoundView(RoundSection):
    """A round with what comes next and its newest run."""

    is_of_file: Annotated[bool, Field(description="the cell file defines it, so it is changed there")]
    next_s: Annotated[float, Field(description="its next time after now, seconds since 1970")]
    waiting_s: Annotated[float | None, Field(description="time of the run that is due and has not begun")]
    waits_for: Annotated[str, Field(description="what that run waits for")]
    newest: RunView | None


class RoundList(BaseModel):
    """All rounds, those of the cell file last."""

    rounds: list[RoundView]


class RunList(BaseModel):
    """Runs, newest first."""

    runs: list[RunView]


@router.get("", summary="Rounds, with what comes next", operation_id="list_rounds")
async def list_rounds(state: State) -> RoundList:
    rounds = state.service.plant.rounds

    def found() -> list[RoundView]:
        newest = {one.section.name: rounds.runs(one.section.name, limit=1) for one in rounds.prospects()}
        return [
            RoundView(
                **one.section.model_dump(),
                is_of_file=one.is_of_file,
                next_s=one.next_s,
                waiting_s=one.waiting_s,
                waits_for=one.waits_for,
                newest=RunView.of(newest[one.section.name][0]) if newest[one.section.name] else None,
            )
            for one in rounds.prospects()
        ]

    return RoundList(rounds=await state.in_thread(found))


@router.get("/{round}/runs", summary="Runs of a round, newest first", operation_id="list_round_runs")
async def list_round_runs(state: State, name: RoundName, limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> RunList:
    runs = await state.in_thread(lambda: state.service.plant.rounds.runs(name, limit=limit))
    return RunList(runs=[RunView.of(run) for run in runs])


@router.put(
    "/{round}",
    summary="Add or replace a round that the cell file does not define",
    operation_id="define_round",
    status_code=204,
    openapi_extra=body_schema(RoundSection, EXAMPLE, required=True),
)
async def define_round(state: State, name: RoundName, section: Given) -> Response:
    if section.name != name:
        raise InvalidRequest(
            f"body.name: is {section.name!r}, and the path names {name!r}", hint="give both the same name"
        )

    def define() -> None:
        state.service.plant.check_rounds([section], source="body")
        state.service.commit("round-defined", section.model_dump(mode="json"))
        state.service.plant.rounds.define(section)

    await state.act(define)
    return Response(status_code=204)


@router.delete(
    "/{round}",
    summary="Remove a round that the cell file does not define",
    operation_id="remove_round",
    status_code=204,
)
async def remove_round(state: State, name: RoundName) -> Response:
    def remove() -> None:
        state.service.plant.rounds.remove(name)
        state.service.commit("round-removed", {"name": name})

    await state.act(remove)
    return Response(status_code=204)
