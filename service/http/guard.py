"""Checks every request before any route: known host, own origin, and a body that is not too large."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Callable
from dataclasses import dataclass

from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from hal.errors import Retry
from service.http.load import MAX_BODY_BYTES_OVERALL, Load, body_time_s
from service.http.problems import BodyTimeout, BodyTooLarge, TooManyUploads, problem_response
from service.knowledge.images import MAX_IMAGE_BYTES

MAX_BODY_BYTES = 1_000_000
LARGE_BODIES = {("POST", "/v1/images"): MAX_IMAGE_BYTES}
PROXIED = "panelwright.is_proxied"  # whether the request came through the proxy; a key of the ASGI scope
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
PROMPT = ("/v1/info", "/v1/stop", "/v1/lease", "/v1/tasks", "/v1/devices", "/v1/stream")  # need nothing that computes
LOADED_LOOK_S = 0.02
SECURITY_HEADERS = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; connect-src 'self' "
        b"http://127.0.0.1:* http://localhost:*; frame-ancestors 'none'",
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowed:
    """The names under which this service may be reached.

    Attributes:
        hosts: names that the Host header may have (without port); this refuses DNS rebinding.
        origins: web origins that may send writing requests from a browser.
        proxies: addresses of the proxy that stands before this service ("" for a Unix socket); None without one.
    """

    hosts: frozenset[str]
    origins: frozenset[str]
    proxies: frozenset[str] | None = None


class RequestGuard:
    """ASGI middleware that refuses requests before the application sees them.

    Attributes:
        load: what the requests use at present.
    """

    def __init__(
        self, app: FastAPI, *, allowed: Allowed, count: Callable[[int], None], is_loaded: Callable[[], bool]
    ) -> None:
        self.inner = app
        self._app: ASGIApp = app
        self._allowed = allowed
        self._count = count
        self._is_loaded = is_loaded
        self.load = Load()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request, or pass it on with a limited body, and add security headers to the answer."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        scope = _unwrapped(scope, self._allowed.proxies)
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if refusal is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
            return
        if refusal is not None:
            status, what, hint = refusal
            self._count(status)
            await problem_response(status, "request-refused", what, hint=hint)(scope, receive, send)
            return
        client = (scope.get("client") or ("local",))[0]
        too_many = self.load.refusal(scope["path"], client)
        if too_many is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1013, "reason": too_many})
            return
        if too_many is not None:
            await self._refuse_now("busy", too_many, "wait for their end")(scope, receive, send)
            return
        with self.load.request(client):
            if await self._is_loaded_for(scope["path"]):
                await self._pass_on(scope, receive, send)
            else:
                ends = "the service ends before it has loaded what this request needs"
                await self._refuse_now("ending", ends, "start the service again")(scope, receive, send)

    def _refuse_now(self, code: str, detail: str, hint: str) -> ASGIApp:
        self._count(503)
        return problem_response(503, code, detail, hint=hint, retry=Retry.SAFE, headers={"Retry-After": "1"})

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        with LimitedBody(receive, self.load, most_bytes=_most_bytes(scope)) as body:
            takes = receive if scope["type"] == "websocket" else body.receive
            await self._app(scope, takes, self._sender(send))

    async def _is_loaded_for(self, path: str) -> bool:
        """Let a request that may compute wait at the start, because modules and kernels must not load in two threads at once.

        Returns:
            Whether it may go on; False where the service ends before that.
        """
        if path.startswith(PROMPT) or not path.startswith("/v1/"):
            return True
        while not self._is_loaded() and not self.load.is_ending:  # noqa: ASYNC110 - another thread loads
            await asyncio.sleep(LOADED_LOOK_S)
        return self._is_loaded()

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str, str] | None:
        if self._allowed.proxies is not None and not scope[PROXIED] and not _is_of_this_machine(scope):
            return 403, "only the proxy of this service may connect here", "use the address of the proxy"
        if _hostname(headers.get("host", "")) not in self._allowed.hosts:
            return 400, "this service does not have that Host name", "use the address that `panelwright serve` printed"
        writes = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
        if writes and not self._is_own(headers):
            return 403, "requests from other web pages are refused", "use the page of this service, or no browser"
        length = headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit():
            return 400, "Content-Length is not a number", "send a correct request"
        if int(length[:20]) > _most_bytes(scope):
            return 413, f"a body may have at most {_most_bytes(scope)} bytes", "send less"
        return None

    def _is_own(self, headers: Headers) -> bool:
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return False
        origin = headers.get("origin")
        return origin is None or origin in self._allowed.origins

    def _sender(self, send: Send) -> Send:
        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._count(message["status"])
                have = {name.lower() for name, _ in message["headers"]}
                extra = [pair for pair in SECURITY_HEADERS if pair[0] not in have]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        return with_headers


def _unwrapped(scope: Scope, proxies: frozenset[str] | None) -> Scope:
    """Return the request as the proxy received it: host, scheme and client; those of strangers' headers do not count."""
    client = scope.get("client")
    if proxies is None or (client[0] if client else "") not in proxies:
        return {**scope, PROXIED: False}
    headers = Headers(scope=scope)
    host, scheme, peer = (
        headers.get(f"x-forwarded-{name}", "").rpartition(",")[2] for name in ("host", "proto", "for")
    )
    kept = [pair for pair in scope["headers"] if pair[0] != b"host" or not host]
    unwrapped = {**scope, PROXIED: True, "client": (peer.strip() or "proxy", 0)}
    if host:
        unwrapped["headers"] = [*kept, (b"host", host.strip().encode("latin-1", "replace"))]
    if scheme.strip() in ("http", "https"):
        unwrapped["scheme"] = (
            scheme.strip() if scope["type"] == "http" else {"http": "ws", "https": "wss"}[scheme.strip()]
        )
    return unwrapped


def _is_of_this_machine(scope: Scope) -> bool:
    client = scope.get("client")
    try:
        return client is not None and ipaddress.ip_address(client[0]).is_loopback
    except ValueError:
        return False


def _most_bytes(scope: Scope) -> int:
    """Return the largest size of a request's body, which is larger for images."""
    return LARGE_BODIES.get((scope.get("method", ""), scope["path"]), MAX_BODY_BYTES)


class LimitedBody:
    """Receives a body with limits for its size, its time and the memory of all bodies; a context that releases the memory.

    The bytes that really arrive are counted, because a chunked body announces no length.
    """

    def __init__(self, receive: Receive, load: Load, *, most_bytes: int) -> None:
        self._receive = receive
        self._load = load
        self._most_bytes = most_bytes
        self._total = 0
        self._begun_s = asyncio.get_running_loop().time()
        self._is_complete = False

    def __enter__(self) -> LimitedBody:
        return self

    def __exit__(self, *_error: object) -> None:
        self._load.body_bytes -= self._total

    async def receive(self) -> Message:
        """Return the next message.

        Raises:
            BodyTooLarge, BodyTimeout, TooManyUploads: a limit was exceeded.
        """
        if self._is_complete:  # the application waits for the client to leave
            return await self._receive()
        left_s = self._begun_s + body_time_s(self._total) - asyncio.get_running_loop().time()
        try:
            async with self._load.body_time(left_s):
                message = await self._receive()
        except TimeoutError:
            raise BodyTimeout from None
        if message["type"] == "http.request":
            self._take(len(message.get("body", b"")))
            self._is_complete = not message.get("more_body", False)
        return message

    def _take(self, size: int) -> None:
        self._total += size
        self._load.body_bytes += size
        if self._total > self._most_bytes:
            raise BodyTooLarge
        if self._load.body_bytes > MAX_BODY_BYTES_OVERALL:
            raise TooManyUploads


def _hostname(host: str) -> str:
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    return name.strip("[]").lower()
