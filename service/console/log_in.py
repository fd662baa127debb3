"""Asks for a key before the first page, and passes log-in and log-out on to the service, whose session is the console's."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request, Response
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from hal.errors import CellError
from service.console.people import People

LOGIN = "/login.html"
SERVICE_WEB = Path(__file__).parents[1] / "web"
LOGIN_FILES = (LOGIN, "/login.js", "/style.css", "/icon.svg")  # the service's own page


class LogInFirst:
    """ASGI middleware: a page has its person's mirror as `request.state.mirror`, or the person is sent to the log-in page.

    Args:
        people: those who use the console.
        pages: paths of the pages.
    """

    def __init__(self, app: ASGIApp, *, people: People, pages: Collection[str]) -> None:
        self._app = app
        self._people = people
        self._pages = pages

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or redirect it."""
        if scope["type"] != "http" or scope["path"] not in self._pages:
            await self._app(scope, receive, send)
            return
        mirror = await self._people.enter(HTTPConnection(scope).cookies)
        if mirror is None:
            answer = RedirectResponse(
                f"{LOGIN}?next={quote(scope['path'], safe='')}", 303, {"Cache-Control": "no-store"}
            )
            await answer(scope, receive, send)
            return
        scope.setdefault("state", {})["mirror"] = mirror
        await self._app(scope, receive, send)


def install_log_in(app: FastAPI, people: People) -> None:
    """Add the log-in page, and the call by which it logs a browser in or out."""
    for path in LOGIN_FILES:
        app.add_api_route(path, sender(SERVICE_WEB / path[1:]), methods=["GET"])

    @app.post("/v1/session")
    async def log_in(request: Request) -> Response:
        return await _passed_on(people, request, await request.json())

    @app.delete("/v1/session")
    async def log_out(request: Request) -> Response:
        return await _passed_on(people, request, None)


def sender(file: Path) -> Callable[[], FileResponse]:
    """Return a route that sends a file."""
    return lambda: FileResponse(file)


def _for_page(cookie: str, request: Request) -> str:
    """Return a cookie as the page may keep it: one that came over TLS, also to a proxy, goes out over TLS only."""
    is_https = "https" in (request.url.scheme, request.headers.get("x-forwarded-proto", ""))
    return f"{cookie}; Secure" if is_https and "secure" not in cookie.lower().split("; ") else cookie


async def _passed_on(people: People, request: Request, body: Any) -> Response:
    """Return the service's answer, with the cookie that it sets."""
    try:
        answer = await people.client_of(request.cookies).answer(request.method, "/v1/session", body)
    except CellError as error:
        return JSONResponse({"detail": error.what, "hint": error.hint}, 503)
    passed = Response(answer.content, answer.status_code, media_type=answer.headers.get("content-type"))
    for cookie in answer.headers.get_list("set-cookie"):
        passed.headers.append("set-cookie", _for_page(cookie, request))
    return passed
