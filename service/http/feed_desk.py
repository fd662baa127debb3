"""Answers those that follow the readings and the changes of alarms of a cell.

However many programs wait, a change costs one look at the files and one rendering; to wait costs nothing. Those that follow
the stream are told without a turn of the event loop for each.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, Field
from starlette.types import Message, Send

from service.http.history import HistoryReading, reading_view
from service.http.hub import Hub
from service.plant import Plant

BATCH = 200
KEPT_LOOKS = 64  # answers that are kept until the next change, for all that know equally much
ALIVE_S = 15.0  # a stream sends an empty line so often, so that both sides notice a broken connection
ALIVE = b":\n\n"
Push = Callable[[bytes], bool]
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
        event: the same as a server-sent event.
        chunk: that event as a chunk of an HTTP/1.1 answer (RFC 9112, 7.1).
        next: where it ends.
        is_news: whether there is anything in it.
    """

    body: bytes
    event: bytes
    next: Place
    is_news: bool
    chunk: bytes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "chunk", b"%x\r\n%b\r\n" % (len(self.event), self.event))


@dataclass(eq=False, slots=True, kw_only=True)
class Follower:
    """A program that is told all that comes after its place.

    Attributes:
        send: of its connection, as in ASGI.
        push: writes a chunk at once, or returns False; see `LimitedProtocol.push`. None: it is told by `send` only.
        may: whether its key is valid still.
        is_stirred: set when it must look itself.
    """

    send: Send
    push: Push | None
    may: Callable[[], bool]
    place: Place
    is_stirred: asyncio.Event = field(default_factory=asyncio.Event)

    async def tell(self, found: Found) -> None:
        """Send what was found, and wait while the connection is full."""
        await self.send(part_of_answer(found.event if found.is_news else ALIVE))
        self.place = found.next


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
        self._followers: set[Follower] = set()  # those that know everything
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

    async def follow(self, follower: Follower) -> None:
        """Tell a follower all that comes, until it may not be told any more or this desk closes."""
        while not self.is_closing and follower.may():
            news = self._news  # taken before the look, so that no change falls between the two
            found = await self._look(follower.place)
            if found.is_news or found.next != follower.place:
                await follower.tell(found)
            elif news is self._news:
                await self._push_to(follower)

    async def _push_to(self, follower: Follower) -> None:
        """Let what comes be pushed to a follower until it must look itself or see a sign of life."""
        follower.is_stirred.clear()
        self._awaited = follower.place
        self._followers.add(follower)
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(ALIVE_S):
                    await follower.is_stirred.wait()
        finally:
            self._followers.discard(follower)
        if not follower.is_stirred.is_set():
            await follower.send(part_of_answer(ALIVE))

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
        place = self._awaited
        found = None
        try:
            found = None if place is None else _found(self._plant, place)
        except Exception:
            log.exception("the feed cannot be read")  # who waits looks again, and is told
        self._awaited = None if found is None or not self._followers else found.next
        self._call(self._wake, place, found)

    def _wake(self, place: Place | None, found: Found | None) -> None:
        """Push what was found to the followers that stand there, and let the others that wait look."""
        if place is not None and found is not None and found.is_news:
            self._looks, self._looked_at = {}, self._version()
            look = self._looks[place] = asyncio.get_running_loop().create_future()
            look.set_result(found)
        for follower in tuple(self._followers):
            if found is None or follower.place != place or not self._has_pushed(follower, found):
                follower.is_stirred.set()
        news, self._news = self._news, asyncio.Event()
        news.set()

    def _has_pushed(self, follower: Follower, found: Found) -> bool:
        """Return whether a follower knows now what was found; False if it must look itself."""
        if not found.is_news:
            return found.next == follower.place
        if follower.push is None or not follower.may() or not follower.push(found.chunk):
            return False
        follower.place = found.next
        return True

    def _version(self) -> tuple[int, int]:
        return self._plant.history.version, self._plant.changes

    def _call(self, what: Callable[..., None], *given: object) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(what, *given)


def part_of_answer(body: bytes) -> Message:
    """Return the ASGI message that sends a part of an answer."""
    return {"type": "http.response.body", "body": body, "more_body": True}


def _found(plant: Plant, place: Place) -> Found:
    """Look at the files, and render what has come after a place."""
    history = plant.history
    if place.readings_after is None:
        rows, after = [], history.reader().newest_id()
    else:
        rows = history.after(place.readings_after, limit=BATCH)
        after = rows[-1].id if rows else min(place.readings_after, history.reader().newest_id())  # a history begun anew
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
    body = feed.model_dump_json().encode()
    return Found(
        body=body,
        event=b"id: %d-%d\ndata: %b\n\n" % (feed.readings_after, feed.alarms_after, body),
        next=Place(feed.readings_after, feed.alarms_after),
        is_news=bool(rows or changes),
    )
