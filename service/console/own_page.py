"""Refuses requests of other web pages to the console, which may move the arm on behalf of whoever opens it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

Message = MutableMapping[str, Any]
App = Callable[[Message, Callable[[], Awaitable[Message]], Callable[[Message], Awaitable[None]]], Awaitable[None]]
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
SECURITY_HEADERS = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How browsers reach the console.

    Attributes:
        names: names beside those of this machine, in lower case and without port.
        schemes: of the pages: `https` where the console has TLS, both behind a proxy.
        peers: addresses of the proxy that stands before it, beside this machine; None without one.
        is_local: whether only this machine reaches it; if not, even the stop asks for a session.
    """

    names: frozenset[str] = frozenset()
    schemes: frozenset[str] = frozenset({"http"})
    peers: frozenset[str] | None = None
    is_local: bool = True


LOCAL = Reach()


class OwnPageOnly:
    """ASGI middleware: the Host must be a name of the console, and an Origin must be that Host.

    The first refuses DNS rebinding, the second other pages in the same browser. `ssh -L` keeps both true on any port. A proxy
    passes the Host on as the browser sent it.
    """

    def __init__(self, app: App, *, reach: Reach = LOCAL) -> None:
        self._app = app
        self._reach = reach

    async def __call__(
        self, scope: Message, receive: Callable[[], Awaitable[Message]], send: Callable[[Message], Awaitable[None]]
    ) -> None:
        """Pass the request on, or refuse it with 403."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in scope["headers"]}
        peer = (scope.get("client") or ("127.0.0.1",))[0]
        if is_own(headers, self._reach) and is_peer(peer, self._reach):
            await self._app(scope, receive, _with_headers(send) if scope["type"] == "http" else send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
            await send({"type": "http.response.body", "body": b"use the address that `panelwright serve` printed\n"})


def is_peer(address: str, reach: Reach) -> bool:
    """Return whether this address may connect: behind a proxy, only the proxy and this machine may."""
    return reach.peers is None or address in reach.peers or address in ("127.0.0.1", "::1")


def is_own(headers: dict[str, str], reach: Reach = LOCAL) -> bool:
    """Return whether a request with these headers (lower-case names) comes from the console's own page or no browser."""
    host = headers.get("host", "").lower()
    name = host if host.endswith("]") else host.rsplit(":", 1)[0]
    origin = headers.get("origin")
    from_elsewhere = (
        headers.get("sec-fetch-site", "none") == "cross-site" and headers.get("sec-fetch-mode") != "navigate"
    )
    own_origins = (None, *(f"{scheme}://{host}" for scheme in reach.schemes))
    return (name in LOCAL_NAMES or name in reach.names) and not from_elsewhere and origin in own_origins


def _with_headers(send: Callable[[Message], Awaitable[None]]) -> Callable[[Message], Awaitable[None]]:
    async def sender(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *SECURITY_HEADERS]}
        await send(message)

    return sender
