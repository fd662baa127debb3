"""Bounds what clients may use of the HTTP port, so that silent or greedy ones shut nobody out.

A head must come within 5 s, a body at a least speed. When there are too many connections, the one of the greediest client
that has been silent for the longest time is closed. Stops and health are answered whatever the load.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_S = 5.0
BODY_S = 5.0  # for a body, and one second more for each BODY_BYTES_PER_S that have arrived
BODY_BYTES_PER_S = 50_000
MAX_CONNECTIONS = 400  # far fewer than the 1024 files that a process may usually open
MAX_REQUESTS = 300  # in work at the same time, streams included
MAX_REQUESTS_OF_CLIENT = 200
MAX_BODY_BYTES_OVERALL = 100_000_000
PUSH = "panelwright.push"  # ASGI extension with `push` of `LimitedProtocol`, where an answer is sent in chunks
VITAL = frozenset({"/v1/stop", "/healthz", "/readyz"})


class Load:
    """What the clients of one server use at present; only its event loop may call it, except `end`.

    Attributes:
        body_bytes: bytes of bodies in memory.
        is_ending: whether the server ends.
    """

    def __init__(self) -> None:
        self.body_bytes = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._limits: set[asyncio.Timeout] = set()
        self.is_ending = False
        self._running: Counter[str] = Counter()
        self._open: set[LimitedProtocol] = set()
        self._waiting: dict[LimitedProtocol, None] = {}  # for a head; the longest wait first

    def refusal(self, path: str, client: str) -> str | None:
        """Return why a request for `path` must wait; None if it may run."""
        if path in VITAL:
            return None
        if self._running[client] >= MAX_REQUESTS_OF_CLIENT:
            return f"{self._running[client]} requests of your machine are in work"
        in_work = self._running.total()
        return f"{in_work} requests are in work" if in_work >= MAX_REQUESTS else None

    @asynccontextmanager
    async def body_time(self, left_s: float) -> AsyncIterator[None]:
        """Limit the time of a part of a body.

        Raises:
            TimeoutError: the time is over, or the server ends.
        """
        self._loop = asyncio.get_running_loop()
        async with asyncio.timeout(0.0 if self.is_ending else max(0.0, left_s)) as limit:
            self._limits.add(limit)
            try:
                yield
            finally:
                self._limits.discard(limit)

    def end(self) -> None:
        """Refuse bodies that have not arrived yet, because the server ends; may be called from any thread."""
        self.is_ending = True
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._end_bodies)

    def _end_bodies(self) -> None:
        for limit in self._limits:
            limit.reschedule(0.0)

    @contextmanager
    def request(self, client: str) -> Iterator[None]:
        """Count a request while it is in work."""
        self._running[client] += 1
        try:
            yield
        finally:
            self._running[client] -= 1
            if not self._running[client]:
                del self._running[client]

    def opened(self, connection: LimitedProtocol) -> None:
        """Count a connection; of too many, close one that waits for its head.

        It is the one that has waited for the longest time, among those of the client that has the most connections.
        """
        self._open.add(connection)
        self.waits(connection)
        if len(self._open) > MAX_CONNECTIONS:
            greedy = Counter(one.host for one in self._open).most_common(1)[0][0]
            oldest = next(iter(self._waiting))  # the new one at least
            next((one for one in self._waiting if one.host == greedy), oldest).give_up()

    def closed(self, connection: LimitedProtocol) -> None:
        """Count a connection no more."""
        self._open.discard(connection)
        self._waiting.pop(connection, None)

    def waits(self, connection: LimitedProtocol) -> None:
        """Note that a connection waits for a head."""
        self._waiting[connection] = None

    def works(self, connection: LimitedProtocol) -> None:
        """Note that a request of a connection is in work."""
        self._waiting.pop(connection, None)


class LimitedProtocol(H11Protocol):
    """uvicorn's HTTP protocol with a time limit for heads, and an account of its connections."""

    load: Load

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn
        """Begin to wait for the first head."""
        super().connection_made(transport)
        self.host = self.client[0] if self.client else ""  # behind a proxy that of the proxy
        self._head_timer: asyncio.TimerHandle | None = None
        self._await_head()
        self.load.opened(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._head_came()
        self.load.closed(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take data; the first bytes of a further head begin its time."""
        super().data_received(data)
        if self.transport.get_protocol() is not self:  # it has become a WebSocket, which has limits of its own
            self._head_came()
            self.load.closed(self)
        elif self._is_between_requests():
            self._await_head()
        else:
            self._head_came()
            self.load.works(self)
            if self.scope["http_version"] == "1.1" and self.scope["method"] == "GET":  # else the answer has no chunks
                self.scope["extensions"] = {PUSH: {"push": self.push}}

    def push(self, chunk: bytes) -> bool:
        """Write a chunk of an answer that is being streamed; False where the connection is full, and nothing was written.

        It does what `send` of ASGI does, in half the time: that passes four layers which have nothing to do with it.
        """
        if self.transport.is_closing() or self.transport.get_write_buffer_size():
            return False
        self.transport.write(chunk)
        return True

    def on_response_complete(self) -> None:
        """Note that the connection waits for its next head."""
        super().on_response_complete()
        if self._is_between_requests():
            self.load.waits(self)

    def give_up(self) -> None:
        """Close a connection whose head does not come."""
        self.load.closed(self)
        self._head_came()
        self.transport.close()

    def _is_between_requests(self) -> bool:
        return self.cycle is None or bool(self.cycle.response_complete)

    def _await_head(self) -> None:
        if self._head_timer is None:
            self._head_timer = self.loop.call_later(HEAD_S, self.give_up)

    def _head_came(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None


def limited_protocol(load: Load) -> type[LimitedProtocol]:
    """Return the protocol class of one server."""

    class OfServer(LimitedProtocol):
        """Protocol of the connections of one server."""

    OfServer.load = load
    return OfServer


def body_time_s(received_bytes: int) -> float:
    """Return how long a body of which so much has arrived may take since its head."""
    return BODY_S + received_bytes / BODY_BYTES_PER_S
