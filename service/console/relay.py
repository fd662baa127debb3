"""Passes on to the browser what only the service has: pictures, crops, reports, what the form for teaching asks, and the stop
as its second way.
"""

from __future__ import annotations

import re
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from hal.errors import CellError
from service.client import ApiError
from service.console.log_in import sender
from service.console.people import People
from service.console.service_client import QUICK_S, ServiceClient
from service.console.teach_page import SCRIPTS, SERVICE_WEB

# What a page may fetch through the console: read only, and nothing that moves.
PICTURES = re.compile(
    r"/v1/(devices/[a-z0-9_]{1,64}/reading|history/[a-z0-9_]{1,41}/crops/[0-9a-f]{64}"
    r"|missions/[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}/[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
    r"|tasks/[0-9a-z]{1,64}/artefacts/[A-Za-z0-9_][A-Za-z0-9_.-]{0,99})"
)
# What the form for teaching asks; the service decides what the person may do.
CALLS = re.compile(
    r"GET /v1/(knowledge|knowledge/questions|images|images/[0-9a-f]{1,64}|devices|devices/[a-z0-9_]{1,64}/reading"
    r"|tasks/[0-9a-z]{1,64}|tasks/[0-9a-z]{1,64}/artefacts/[A-Za-z0-9_][A-Za-z0-9_.-]{0,99})"
    r"|POST /v1/(knowledge/outline|knowledge/teach|images|recognise|inspect|learn)"
    r"|DELETE /v1/knowledge/(kinds|panels)/[a-z][a-z0-9_]{0,40}"
)
MOST_BYTES = 33_000_000  # an image that the service takes is at most 32 MB
MEDIA = {".html": "text/html; charset=utf-8", ".json": "application/json", ".pdf": "application/pdf"}
REPORT_POLICY = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline' 'self'; frame-ancestors 'none'"


def install_relay(app: FastAPI, people: People, *, is_local: bool = True) -> None:
    """Add the routes under `/relay` to the console's application.

    Args:
        is_local: whether only this machine reaches the console. The service lets this machine stop without a key, and
            takes the console for this machine, so that the console itself asks others for their session.
    """

    @app.get("/relay/stop")
    async def stop_state(request: Request) -> Response:
        return await _passed_on(people.client_of(request.cookies), "GET", "/v1/stop", timeout_s=QUICK_S)

    @app.post("/relay/stop")
    async def stop(request: Request) -> Response:
        if not is_local and await people.enter(request.cookies) is None:
            return Response("log in to stop from here\n", 401, media_type="text/plain")
        return await _passed_on(people.client_of(request.cookies), "POST", "/v1/stop", timeout_s=QUICK_S)

    @app.post("/relay/stop/reset")
    async def reset(request: Request) -> Response:
        return await _passed_on(people.client_of(request.cookies), "POST", "/v1/stop/reset", await request.json())

    for name in SCRIPTS:
        app.add_api_route(f"/teach/{name}", sender(SERVICE_WEB / name), methods=["GET"])

    @app.api_route("/v1/{path:path}", methods=["GET", "POST", "DELETE"])
    async def call(path: str, request: Request) -> Response:
        wanted = f"/v1/{path}"
        if not CALLS.fullmatch(f"{request.method} {wanted}"):
            return Response("the console does not pass this on\n", 404, media_type="text/plain")
        return await _asked(people.client_of(request.cookies), wanted, request)

    @app.get("/relay/{path:path}")
    async def file(path: str, request: Request) -> Response:
        wanted = f"/{path}"
        if not PICTURES.fullmatch(wanted):
            return Response("there is nothing here\n", 404, media_type="text/plain")
        query = "?format=png&max_age_s=0.5" if wanted.endswith("/reading") else ""
        suffix = wanted[wanted.rfind(".") :] if "." in wanted.rpartition("/")[2] else ""
        client = people.client_of(request.cookies)
        return await _passed_on(client, "GET", wanted + query, media=MEDIA.get(suffix, "image/png"))


async def _asked(client: ServiceClient, path: str, request: Request) -> Response:
    """Return the service's answer to a request as it came, also a problem."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MOST_BYTES:
            return JSONResponse({"detail": "that is more than 32 MB", "hint": "send a smaller image"}, 413)
    query = f"?{request.url.query}" if request.url.query else ""
    media = request.headers.get("content-type")
    try:
        answer = await client.answer(request.method, path + query, content=bytes(body), media=media)
    except CellError as error:
        return JSONResponse({"detail": error.what, "hint": error.hint}, 503)
    told = answer.headers.get("content-type")
    return Response(answer.content, answer.status_code, media_type=told, headers={"Cache-Control": "no-store"})


async def _passed_on(
    client: ServiceClient,
    method: str,
    path: str,
    body: Any = None,
    *,
    media: str = "application/json",
    timeout_s: float = 40.0,
) -> Response:
    headers = {"Cache-Control": "no-store"}
    if media.startswith("text/html"):
        headers["Content-Security-Policy"] = REPORT_POLICY
    try:
        data = await client.fetch(method, path, body, timeout_s=timeout_s)
    except ApiError as error:
        return Response(f"{error.what}\n{error.hint}\n", 502, media_type="text/plain", headers=headers)
    except CellError as error:
        return Response(f"{error.what}\n{error.hint}\n", 503, media_type="text/plain", headers=headers)
    return Response(data, media_type=media, headers=headers)
