"""`/v1/history`: the readings of every object over time, as pages, trends and files."""

from __future__ import annotations

import csv
import functools
import io
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query
from pydantic import BaseModel, Field
from starlette.background import BackgroundTask
from starlette.responses import FileResponse, Response, StreamingResponse

from hal.errors import InvalidRequest
from service.errors import NoSuchTask
from service.history.parts import write_parquet
from service.history.query import Query as Question
from service.history.query import Row
from service.history.reading import COLUMNS
from service.http.problems import RESPONSES
from service.http.state import AppState, State

router = APIRouter(prefix="/v1/history", tags=["history"], responses=RESPONSES)
ObjectName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,40}$", examples=["pressure"])]
Moment = Annotated[float | None, Query(ge=0.0, le=1e11, allow_inf_nan=False, description="seconds since 1970")]
HEAD = ("id", *COLUMNS)


class CertificateView(BaseModel):
    """What judged cases say about readings of this kind and regime; or `none` with the reason, and nothing else."""

    at_most: Annotated[
        float | None, Field(description="of sure readings of this kind here, at most this share is wrong")
    ] = None
    assurance: Annotated[float | None, Field(description="probability with which that bound holds")] = None
    cases: Annotated[int | None, Field(description="independent judged cases")] = None
    wrong: Annotated[int | None, Field(description="how many of these were wrong")] = None
    source: Annotated[str | None, Field(description="`simulation`, or `site`: answers of people")] = None
    id: Annotated[str | None, Field(description="of the file of the certificate")] = None
    none: Annotated[str | None, Field(description="why there is no certificate")] = None


class HistoryReading(BaseModel):
    """A stored reading. `quality` is `valid` or `invalid`; an invalid one has a `cause` and no value, state or text.

    `sigma` is the standard deviation of `value`, `told` what the object was last told to be, `crop_url` its picture.
    """

    id: int
    object: str
    kind: str
    utc_s: Annotated[float, Field(description="seconds since 1970")]
    cell_s: Annotated[float, Field(description="the same moment on the cell's clock")]
    quality: str
    cause: str
    value: float | None
    unit: str
    sigma: float | None
    state: str | None
    text: str | None
    confidence: float
    guess: Annotated[str | None, Field(description="JSON: what an invalid reading withholds, and its rivals")]
    verb: str
    task: str
    mission: str
    asked_by: str
    phase: str
    told: str | None
    crop_url: str | None
    sure: Annotated[bool, Field(description="it was given, is above the cell's sure line, and nothing contradicts it")]
    doubt: Annotated[str, Field(description="why a person should look at it; empty for a sure one")]
    certificate: Annotated[CertificateView | None, Field(description="null for a reading of an older version")]
    answered: Annotated[
        str | None, Field(description="JSON: what a person has said about it: by, verdict, reason, at_s")
    ]
    final_value: Annotated[float | None, Field(description="what it shows by that answer; so are the next two")]
    final_state: str | None
    final_text: str | None


class BucketView(BaseModel):
    """What was read in one span of time; refused readings are counted and go into nothing else."""

    since_s: float
    until_s: float
    count: int
    refused: int
    minimum: float | None
    maximum: float | None
    mean: float | None
    states: dict[str, int]


class HistoryPage(BaseModel):
    """Readings in the order in which they were stored, or `buckets` if they were asked for.

    `next_after` is what to send as `after` for the next page; null on the last one.
    """

    object: str
    readings: list[HistoryReading] = []
    buckets: list[BucketView] = []
    next_after: int | None = None


class HistoryOverview(BaseModel):
    """The newest reading of each object, and the damaged files that were set aside."""

    newest: list[HistoryReading]
    set_aside: list[str]


@router.get("", summary="Newest reading of each object", operation_id="history_overview")
async def history_overview(state: State) -> HistoryOverview:
    history, cell = state.service.plant.history, state.service.cell.name
    rows = await state.in_thread(lambda: history.reader().newest(cell))
    return HistoryOverview(
        newest=[reading_view(row) for row in rows], set_aside=[path.name for path in history.set_aside]
    )


@router.get(
    "/export",
    summary="Readings as a file: CSV, or Parquet with the extra `history`",
    operation_id="export_history",
    response_class=Response,
    responses={200: {"content": {"text/csv": {}, "application/vnd.apache.parquet": {}}}},
)
async def export_history(
    state: State,
    format: Literal["csv", "parquet"] = "csv",
    object: Annotated[str | None, Query(pattern=r"^[a-z][a-z0-9_]{0,40}$")] = None,
    since_s: Moment = None,
    until_s: Moment = None,
) -> Response:
    question = _question(state, object, since_s, until_s)
    if format == "csv":
        headers = {"Content-Disposition": "attachment; filename=history.csv"}
        lines = state.service.plant.history.reader().all(question)
        first = await state.in_thread(
            lambda: next(lines, None)
        )  # a file that cannot be read is an error, not half an answer
        return StreamingResponse(_csv(first, lines), media_type="text/csv; charset=utf-8", headers=headers)
    path = await state.in_thread(functools.partial(_parquet, state, question))
    return FileResponse(
        path,
        media_type="application/vnd.apache.parquet",
        filename="history.parquet",
        background=BackgroundTask(lambda: path.unlink(missing_ok=True)),
    )


@router.get("/{object}", summary="Readings of one object: pages, or a trend", operation_id="show_history")
async def show_history(
    state: State,
    object: ObjectName,
    since_s: Moment = None,
    until_s: Moment = None,
    after: Annotated[int, Query(ge=0, lt=2**62, description="only readings with a larger id")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000, description="most readings of one page")] = 200,
    last: Annotated[
        int, Query(ge=0, le=1000, description="0: pages from the oldest on. Otherwise only the newest so many readings")
    ] = 0,
    buckets: Annotated[
        int, Query(ge=0, le=2000, description="0: readings. Otherwise least, greatest and mean value of so many spans")
    ] = 0,
) -> HistoryPage:
    question = _question(state, object, since_s, until_s)
    reader = state.service.plant.history.reader()
    if buckets:
        found = await state.in_thread(functools.partial(reader.trend, question, buckets=buckets))
        return HistoryPage(object=object, buckets=[BucketView(**asdict(bucket)) for bucket in found])
    if last:
        newest = await state.in_thread(functools.partial(reader.last, question, limit=last))
        return HistoryPage(object=object, readings=[reading_view(row) for row in newest])
    rows = await state.in_thread(functools.partial(reader.page, question, after=after, limit=limit))
    return HistoryPage(
        object=object,
        readings=[reading_view(row) for row in rows],
        next_after=rows[-1].id if len(rows) == limit else None,
    )


@router.get(
    "/{object}/crops/{crop}",
    summary="The picture of an object at a reading",
    operation_id="fetch_crop",
    response_class=FileResponse,
    responses={200: {"content": {"image/png": {}}}},
)
async def fetch_crop(
    state: State, object: ObjectName, crop: Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]
) -> FileResponse:
    path = await state.in_thread(lambda: state.service.plant.history.crops.path(crop))
    if path is None:
        raise NoSuchTask("there is no such picture, or it is not kept any more", hint=f"GET /v1/history/{object}")
    return FileResponse(path, media_type="image/png")


def _question(state: AppState, name: str | None, since_s: float | None, until_s: float | None) -> Question:
    if since_s is not None and until_s is not None and until_s < since_s:
        raise InvalidRequest("query.until_s: ends before since_s", hint="swap them")
    return state.service.plant.history.ask(object=name, since_s=since_s, until_s=until_s)


def reading_view(row: Row) -> HistoryReading:
    """Return a stored reading as the API shows it."""
    plain = {
        name: getattr(row.reading, name) for name in COLUMNS
    }  # `asdict` copies each, which takes ten times as long
    crop = plain.pop("crop")
    url = None if crop is None else f"/v1/history/{row.reading.object}/crops/{crop}"
    said = plain.pop("certificate")
    certificate = None if said is None else CertificateView.model_validate_json(said)
    return HistoryReading(id=row.id, crop_url=url, sure=row.reading.is_sure, certificate=certificate, **plain)


def _csv(first: Row | None, lines: Iterator[Row]) -> Iterator[str]:
    """Yield a CSV file in pieces, with a line of names first."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(HEAD)
    row = first
    while row is not None:
        writer.writerow(_cells(row))
        if text.tell() > 60_000:
            yield text.getvalue()
            text.seek(0)
            text.truncate()
        row = next(lines, None)
    yield text.getvalue()


def _cells(row: Row) -> list[Any]:
    return [row.id, *asdict(row.reading).values()]


def _parquet(state: AppState, question: Question) -> FilePath:
    with tempfile.NamedTemporaryFile(suffix=".parquet", delete=False) as file:
        path = FilePath(file.name)
    try:
        write_parquet(path, HEAD, (_cells(row) for row in state.service.plant.history.reader().all(question)))
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path
