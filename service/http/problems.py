"""Converts every error to an RFC 9457 problem, none of which repeats the caller's input."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from difflib import get_close_matches
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from hal.errors import CellError, Retry
from service.errors import Busy, Unauthenticated, of_file
from service.problem import problem_of, status_of

MEDIA = "application/problem+json"
log = logging.getLogger(__name__)


class FieldFault(BaseModel):
    """One fault of a request; `path` says where it is, e.g. `body.actions.0.object`."""

    path: str
    message: str


class Problem(BaseModel):
    """An RFC 9457 problem with a hint on how to solve it."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:panelwright:device-timeout",
                "title": "Device timeout",
                "status": 504,
                "detail": "wrist_ft silent for 0.50 s; last good reading 3.2 s old",
                "hint": "check power and cable; another program may hold the port",
                "retry": "safe",
                "details": {"device": "wrist_ft"},
            }
        }
    )

    type: Annotated[str, Field(description="stable name of the type of problem")]
    title: str
    status: int
    detail: Annotated[str, Field(description="what happened this time")]
    hint: Annotated[str, Field(description="what to do about it")]
    retry: Annotated[Retry, Field(description="whether the same request may be sent again")]
    details: dict[str, Any] = {}
    errors: list[FieldFault] = []


class ProblemResponse(Response):
    """A response with a problem document."""

    media_type = MEDIA


def problem_response(
    status: int,
    name: str,
    what: str,
    *,
    hint: str,
    retry: Retry = Retry.AFTER_FIX,
    faults: list[FieldFault] | None = None,
    headers: dict[str, str] | None = None,
) -> ProblemResponse:
    """Return the response for a problem that is not a `CellError`."""
    body = Problem(
        type=f"urn:panelwright:{name}",
        title=name.replace("-", " ").capitalize(),
        status=status,
        detail=what,
        hint=hint,
        retry=retry,
        errors=faults or [],
    )
    return ProblemResponse(body.model_dump_json(), status_code=status, headers=headers)


def error_response(error: CellError) -> ProblemResponse:
    """Return the response for a `CellError`."""
    headers = {"Retry-After": "1"} if isinstance(error, Busy) or error.retry is Retry.SAFE else None
    if isinstance(error, Unauthenticated):
        headers = {"WWW-Authenticate": 'Bearer realm="panelwright"'}
    return ProblemResponse(json.dumps(problem_of(error)), status_code=status_of(error), headers=headers)


def refuse_body(status: int, what: str, *, hint: str, faults: list[FieldFault] | None = None) -> BadBody:
    """Return an exception that becomes a problem, for body readers."""
    return BadBody(status, what, hint, faults or [])


class BadBody(Exception):
    """The request's body is not valid."""

    def __init__(self, status: int, what: str, hint: str, faults: list[FieldFault]) -> None:
        super().__init__(what)
        self.status = status
        self.what = what
        self.hint = hint
        self.faults = faults


class BodyTooLarge(Exception):
    """The request's body has more bytes than allowed."""


class BodyTimeout(Exception):
    """The request's body did not come in time."""


class TooManyUploads(Exception):
    """The bodies of all requests together take too much memory."""


def install(app: FastAPI, *, paths: Sequence[str]) -> None:
    """Register the handlers; `paths` are all known paths, from which the hint for a mistyped one is chosen."""

    _install_for_bodies(app)

    @app.exception_handler(CellError)
    async def _cell_error(_request: Request, error: CellError) -> Response:
        return error_response(error)

    @app.exception_handler(RequestValidationError)
    async def _invalid(_request: Request, error: RequestValidationError) -> Response:
        # pydantic's own text would repeat the input, which may be huge or hostile
        faults = [FieldFault(path=path_of(item["loc"]), message=item["msg"]) for item in error.errors()[:20]]
        what = f"{faults[0].path}: {faults[0].message}" if faults else "the request is not valid"
        return problem_response(422, "invalid-request", what, hint="see /openapi.json", faults=faults)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        name = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
        headers = dict(error.headers) if error.headers else {}
        what, hint = str(error.detail), "see /openapi.json"
        if error.status_code == HTTPStatus.NOT_FOUND:
            what, hint = (
                "there is nothing at this path",
                _near(request.url.path, paths) + "/openapi.json lists all paths",
            )
        elif error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            what = f"this path takes {headers.get('Allow', 'other methods')} only"
        return problem_response(error.status_code, name, what, hint=hint, headers=headers or None)

    @app.exception_handler(OSError)
    async def _file(request: Request, error: OSError) -> Response:
        known = of_file(error)
        if known is None:
            raise error  # a defect
        log.error("%s %s: %s", request.method, request.url.path, known.what)  # a full disk, say
        return error_response(known)

    @app.exception_handler(Exception)
    async def _defect(request: Request, error: Exception) -> Response:
        log.error("%s %s failed by a defect", request.method, request.url.path, exc_info=error)
        what = f"the service has a defect: {type(error).__name__}"
        return problem_response(500, "defect", what, hint="the log has more; please report it", retry=Retry.NEVER)


def _install_for_bodies(app: FastAPI) -> None:
    """Register the handlers of faults of a request's body."""

    @app.exception_handler(BadBody)
    async def _bad_body(_request: Request, error: BadBody) -> Response:
        return problem_response(error.status, "bad-body", error.what, hint=error.hint, faults=error.faults)

    @app.exception_handler(BodyTooLarge)
    async def _too_large(_request: Request, _error: BodyTooLarge) -> Response:
        return problem_response(
            413, "body-too-large", "the body is too large", hint="send less than 1 MB, an image less than 32 MB"
        )

    @app.exception_handler(ClientDisconnect)
    async def _gone(_request: Request, _error: ClientDisconnect) -> Response:
        # Nobody reads this answer; without a handler the log would report a defect.
        return problem_response(
            400, "body-cut-off", "the client left before its body was complete", hint="send it again"
        )

    @app.exception_handler(BodyTimeout)
    async def _too_slow(_request: Request, _error: BodyTimeout) -> Response:
        what, close = "the body did not come in time", {"Connection": "close"}
        return problem_response(408, "body-timeout", what, hint="send it again", retry=Retry.SAFE, headers=close)

    @app.exception_handler(TooManyUploads)
    async def _too_many(_request: Request, _error: TooManyUploads) -> Response:
        what, later = "too much is being sent at the same time", {"Connection": "close", "Retry-After": "5"}
        return problem_response(503, "busy", what, hint="send it again later", retry=Retry.SAFE, headers=later)


def _near(asked: str, paths: Sequence[str]) -> str:
    """Return a question with the nearest known path; it never repeats the request's path, which may be hostile."""
    near = get_close_matches(asked[:100], paths, n=1, cutoff=0.75)
    return f"did you mean {near[0]}? " if near else ""


def path_of(location: tuple[int | str, ...]) -> str:
    """Return a key path for people; parts that the caller chose are shortened."""
    return ".".join(str(part)[:40] for part in location) or "body"


RESPONSES: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "Problem (RFC 9457)",
        "content": {MEDIA: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}
