"""`/v1/review`: the readings that wait for a person, and the answers."""

from __future__ import annotations

import functools
import json
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi import Depends as DependsOn
from pydantic import BaseModel, Field

from hal.strict import Strict
from service.history.query import Row
from service.http.body import body_schema, strict_body
from service.http.history import HistoryReading, reading_view
from service.http.models import Holder
from service.http.problems import RESPONSES
from service.http.state import Admitted, AppState, State
from service.knowledge.store import KnowledgeStore
from service.knowledge.teach import TaughtView, teach_surroundings
from service.review.desk import Verdict, held_by

router = APIRouter(prefix="/v1/review", tags=["review"], responses=RESPONSES)
ReadingId = Annotated[int, Path(ge=1, lt=2**62, description="number of the reading in the history")]


class Shown(BaseModel):
    """What an object shows or may show."""

    value: float | None = None
    state: str | None = None
    text: str | None = None


class Rival(BaseModel):
    """A number that a refused display may show as well."""

    text: str
    value: float
    probability: float


class ReviewItem(BaseModel):
    """A reading that waits, with why, what it shows or holds back, and its rivals; `reading.crop_url` is its picture."""

    reading: HistoryReading
    why: str
    guess: Shown | None
    rivals: list[Rival]


class ReviewList(BaseModel):
    """How many readings wait, and the newest of them."""

    waiting: int
    readings: list[ReviewItem]


class AnswerRequest(Strict):
    """What a person says about a reading.

    `right`: it shows what was read or held back. `wrong`: it shows `value`, `state` or `text`. `unreadable`: nobody can tell.
    """

    by: Holder
    verdict: Verdict
    reason: Annotated[str, Field(min_length=1, max_length=500)]
    value: Annotated[float | None, Field(ge=-1e12, le=1e12)] = None
    state: Annotated[str | None, Field(max_length=100)] = None
    text: Annotated[str | None, Field(max_length=100)] = None


BODIES = (AnswerRequest,)
Answer = Annotated[AnswerRequest, DependsOn(strict_body(AnswerRequest))]
EXAMPLE = {"by": "alice@console-2", "verdict": "wrong", "reason": "glare on the glass", "value": 5.2}


@router.get("", summary="Readings that wait for a person, newest first", operation_id="list_review")
async def list_review(state: State, limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> ReviewList:
    count, rows = await state.in_thread(lambda: state.service.plant.review.waiting(limit=limit))
    return ReviewList(waiting=count, readings=[_item(row) for row in rows])


@router.post(
    "/{reading}",
    summary="Say what a reading shows",
    operation_id="answer_review",
    openapi_extra=body_schema(AnswerRequest, EXAMPLE, required=True),
)
async def answer_review(state: State, reading: ReadingId, request: Answer) -> HistoryReading:
    shows = {"value": request.value, "state": request.state, "text": request.text}
    given: dict[str, Any] = {"by": request.by, "verdict": request.verdict, "reason": request.reason, "shows": shows}
    return reading_view(await state.act(functools.partial(state.service.plant.review.answer, reading, **given)))


@router.post(
    "/{reading}/teach",
    summary="Teach the look of an answered reading's object, for blind recognition",
    operation_id="teach_reading",
)
async def teach_reading(state: State, _holder: Admitted, reading: ReadingId) -> TaughtView:
    taught = await state.in_thread(functools.partial(_taught, state, reading))
    await state.commit("taught", {"what": taught.what, "name": taught.name, "added": taught.added, "reading": reading})
    return taught


def _taught(state: AppState, number: int) -> TaughtView:
    reading, picture = state.service.plant.review.to_teach(number)
    store = KnowledgeStore.of_runs(state.service.runs_dir, state.service.cell)
    return teach_surroundings(store, picture, kind=reading.kind)


def _item(row: Row) -> ReviewItem:
    one = row.reading
    held = held_by(one) or {key: getattr(one, key) for key in ("value", "state", "text")}
    rivals = [] if one.guess is None else json.loads(one.guess)["possible"]
    return ReviewItem(
        reading=reading_view(row),
        why=one.doubt,
        guess=Shown(**held) if any(item is not None for item in held.values()) else None,
        rivals=[Rival(**rival) for rival in rivals],
    )
