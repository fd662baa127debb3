"""`/v1/feed`: the readings and the changes of alarms of the whole cell, in order, for programs that follow them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Send

from service.http.access import StillMay
from service.http.feed_desk import Feed, FeedDesk, Follower, Found, Place, Push, part_of_answer
from service.http.load import PUSH
from service.http.problems import RESPONSES

router = APIRouter(prefix="/v1/feed", tags=["history"], responses=RESPONSES)
After = Annotated[
    int | None, Query(ge=0, lt=2**62, description="newest that is known; without it, only what comes from now on")
]


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
    request: Request,
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
    return _FollowerStream(desk, first, may, push=request.scope.get("extensions", {}).get(PUSH, {}).get("push"))


class _FollowerStream(StreamingResponse):
    """Sends what was found and all that comes later; the first event also tells where the stream begins."""

    def __init__(self, desk: FeedDesk, first: Found, may: Callable[[], bool], *, push: Push | None) -> None:
        super().__init__((), media_type="text/event-stream")
        self._desk, self._first, self._may, self._push = desk, first, may, push

    async def stream_response(self, send: Send) -> None:
        """Send the answer; cancelled when the client leaves."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        await send(part_of_answer(self._first.event))
        await self._desk.follow(Follower(send=send, push=self._push, may=self._may, place=self._first.next))
        await send({"type": "http.response.body", "body": b"", "more_body": False})
