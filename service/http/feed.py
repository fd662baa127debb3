"""`/v1/feed`: the readings and the changes of alarms of the whole cell, in order, for programs that follow them.

However many programs wait, a change costs one look at the files and one rendering; to wait costs nothing.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request
from pydantic import BaseModel, Field
from starlette.responses import Response, StreamingResponse

from service.http.access import StillMay
from service.http.history import HistoryReading, reading_view
from service.http.hub import Hub
from service.http.problems import RESPONSES
from service.plant import Plant

router = APIRouter(prefix="/v1/feed", tags=["history"], responses=RESPONSES)
After = Annotated[
    int | None, Query(ge=0, lt=2**62, description="newest that is known; without it, only what comes from now on")
]
BATCH = 200
KEPT_LOOKS = 64  # answers that are kept until the next change, for all that know equally much
ALIVE_S = 15.0  # a stream without news sends an empty line so often, so that both sides notice a broken connection
log = logging.getLogger(__name__)


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


@dataclass(frozen=True, slots=True)
class Place:
    """The newest reading and change of an alarm that a program knows; None: whatever is the newest when it asks."""

    readings_after: int | None
    alarms_after: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A rendered answer.

    Attributes:
        body: a `Feed` as JSON.
        next: where it ends.
        is_news: whether there is anything in it.
    """

    body: bytes
    next: Place
    is_news: bool


class FeedDesk:
    """Answers those that follow the feed; only the event loop may call it, except `close`.

    What is new is rendered by the thread that stored it, for the place at which somebody waits: to hand that to another thread
    would cost two more turns of an interpreter that a mission keeps busy.
    """

    _plant: Plant  # once it is open

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "feed")
        self._news = asyncio.Event()
        self._looks: dict[Place, asyncio.Future[Found]] = {}
        self._looked_at: object = None
        self._awaited: Place | None = None  # where those stand that wait
        self._loop: asyncio.AbstractEventLoop | None = None
        self.is_closing = False

    def open(self, hub: Hub, plant: Plant) -> None:
        """Listen to the plant until the hub closes; call it inside the event loop."""
        self._loop, self._plant = asyncio.get_running_loop(), plant
        self._plant.listeners.append(self._on_change)
        hub.on_close.append(self.close)

    def close(self) -> None:
        """End all waiting; may be called from any thread."""
        self.is_closing = True
        self._call(self._wake, None, None)

    def release(self) -> None:
        """End the thread, when no request is left."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def ask(self, place: Place, *, wait_s: float) -> Found:
        """Return what has come after a place, as soon as there is something, or nothing new after `wait_s`."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + wait_s
        while True:
            news = self._news  # taken before the look, so that no change falls between the two
            found = await self._look(place)
            left_s = end_s - loop.time()
            if found.is_news or found.next != place or self.is_closing or left_s <= 0.0:
                return found
            try:
                self._awaited = place
                async with asyncio.timeout(left_s):
                    await news.wait()
            except TimeoutError:
                return found
            if self.is_closing:
                return found

    async def _look(self, place: Place) -> Found:
        """Return what has come after a place; those that know equally much share one look until something changes."""
        version = self._version()
        if version != self._looked_at or len(self._looks) >= KEPT_LOOKS:
            self._looks, self._looked_at = {}, version
        look = self._looks.get(place)
        if look is None or (look.done() and look.exception() is not None):
            work = functools.partial(_found, self._plant, place)
            look = self._looks[place] = asyncio.get_running_loop().run_in_executor(self._thread, work)
        return await asyncio.shield(look)

    def _on_change(self) -> None:
        """Look for those that wait, in the thread that made the change, which must not fail by it."""
        place, self._awaited = self._awaited, None
        found = None
        try:
            found = None if place is None else _found(self._plant, place)
        except Exception:
            log.exception("the feed cannot be read")  # who waits looks again, and is told
        self._call(self._wake, place, found)

    def _wake(self, place: Place | None, found: Found | None) -> None:
        """Let those that wait look, with what was found for them."""
        if place is not None and found is not None and found.is_news:
            self._looks, self._looked_at = {}, self._version()
            look = self._looks[place] = asyncio.get_running_loop().create_future()
            look.set_result(found)
        news, self._news = self._news, asyncio.Event()
        news.set()

    def _version(self) -> tuple[int, int]:
        return self._plant.history.version, self._plant.changes

    def _call(self, what: Callable[..., None], *given: object) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(what, *given)


async def desk_of(request: Request) -> FeedDesk:
    """Return the application's desk of the feed."""
    desk: FeedDesk = request.app.state.feed
    return desk


Desk = Annotated[FeedDesk, Depends(desk_of)]


@router.get(
    "",
    summary="Readings and changes of alarms since the last call",
    operation_id="follow_feed",
    response_model=Feed,
)
async def follow_feed(
    desk: Desk,
    readings_after: After = None,
    alarms_after: After = None,
    wait_s: Annotated[
        float, Query(ge=0.0, le=30.0, allow_inf_nan=False, description="wait so long for something")
    ] = 0.0,
) -> Response:
    found = await desk.ask(Place(readings_after, alarms_after), wait_s=wait_s)
    return Response(found.body, media_type="application/json")


@router.get(
    "/events",
    summary="Readings and changes of alarms as server-sent events; resume with Last-Event-ID",
    operation_id="stream_feed",
    response_class=StreamingResponse,
    response_description="one event per change: `data` is what `GET /v1/feed` answers, `id` is where it ends",
    responses={200: {"content": {"text/event-stream": {}}}},
)
async def stream_feed(
    desk: Desk,
    may: StillMay,
    readings_after: After = None,
    alarms_after: After = None,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", pattern=r"^\d{1,18}-\d{1,18}$", description="`id` of the last event")
    ] = None,
) -> StreamingResponse:
    begin = Place(readings_after, alarms_after)
    if last_event_id is not None:
        reading, _, alarm = last_event_id.partition("-")
        begin = Place(int(reading), int(alarm))
    first = await desk.ask(begin, wait_s=0.0)  # an error is an answer, not an empty stream
    return StreamingResponse(_events(desk, first, may), media_type="text/event-stream")


async def _events(desk: FeedDesk, first: Found, may: Callable[[], bool]) -> AsyncIterator[bytes]:
    """Yield what was found and all that comes later; the first event also tells where the stream begins."""
    found = first
    yield _event(found)
    while not desk.is_closing:
        found = await desk.ask(found.next, wait_s=ALIVE_S)
        if not may():
            return
        yield _event(found) if found.is_news else b":\n\n"


def _event(found: Found) -> bytes:
    number = f"{found.next.readings_after}-{found.next.alarms_after}".encode()
    return b"id: %b\ndata: %b\n\n" % (number, found.body)


def _found(plant: Plant, place: Place) -> Found:
    """Look at the files, and render what has come after a place."""
    reader = plant.history.reader()
    if place.readings_after is None:
        rows, after = [], reader.newest_id()
    else:
        rows = reader.page(plant.history.ask(), after=place.readings_after, limit=BATCH)
        after = rows[-1].id if rows else min(place.readings_after, reader.newest_id())  # a history begun anew
    changes = [] if place.alarms_after is None else plant.alarm_changes(place.alarms_after)
    feed = Feed(
        readings=[reading_view(row) for row in rows],
        alarms=[AlarmChange(**change) for change in changes],
        readings_after=after,
        alarms_after=changes[-1]["number"]
        if changes
        else plant.alarms.number
        if place.alarms_after is None
        else place.alarms_after,
    )
    return Found(
        body=feed.model_dump_json().encode(),
        next=Place(feed.readings_after, feed.alarms_after),
        is_news=bool(rows or changes),
    )
