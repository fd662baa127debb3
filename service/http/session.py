"""`/v1/session`: logs a browser in with a key, in exchange for a cookie that scripts cannot read."""

from __future__ import annotations

import functools
from typing import Annotated, Literal

from fastapi import APIRouter, Request
from fastapi import Depends as DependsOn
from pydantic import BaseModel, Field
from starlette.responses import Response

from hal.strict import Strict
from service.access.actor import act_as
from service.access.keys import Role
from service.access.sessions import SESSION_S
from service.errors import Unauthenticated
from service.http.access import Caller
from service.http.body import body_schema, strict_body
from service.http.problems import RESPONSES
from service.http.state import State

router = APIRouter(prefix="/v1/session", tags=["session"], responses=RESPONSES)


class LoginRequest(Strict):
    """A key, as `panelwright keys add` showed it."""

    key: Annotated[str, Field(min_length=1, max_length=200)]


class SessionView(BaseModel):
    """Who asks. `access` is `open` while the service has no keys; then everybody on its machine may do everything."""

    access: Literal["open", "keys"]
    name: Annotated[str | None, Field(description="name of the key, or null")] = None
    role: Annotated[Role | None, Field(description="role of the key; null without a valid key")] = None


@router.get("", summary="Who asks, and in which role", operation_id="show_session")
async def show_session(state: State, request: Request) -> SessionView:
    caller: Caller | None = request.state.caller
    access: Literal["open", "keys"] = "open" if state.service.keys.is_open else "keys"
    return SessionView(
        access=access, name=caller.name if caller is not None else None, role=caller.role if caller else None
    )


@router.post(
    "",
    summary="Log a browser in with a key; the answer sets a cookie",
    operation_id="log_in",
    openapi_extra=body_schema(LoginRequest, {"key": "pw_..."}, required=True),
)
async def log_in(
    state: State,
    request: Request,
    response: Response,
    body: Annotated[LoginRequest, DependsOn(strict_body(LoginRequest))],
) -> SessionView:
    """The cookie holds a token and never the key. It is sent only to this service and only by its own pages."""
    book = state.service.keys
    if book.is_open:
        return SessionView(access="open", role=Role.MAINTAINER)
    key = book.find(body.key)
    if key is None:
        raise Unauthenticated("the key is not valid: unknown, revoked or expired", hint="ask for a new key")
    act_as(key.name)
    await state.act(functools.partial(state.service.commit, "session-opened", {"role": str(key.role)}))
    response.set_cookie(
        state.cookie,
        state.sessions.open(key),
        max_age=int(SESSION_S),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return SessionView(access="keys", name=key.name, role=key.role)


@router.delete("", summary="Log out", operation_id="log_out")
async def log_out(state: State, request: Request, response: Response) -> SessionView:
    token = request.cookies.get(state.cookie)
    if token is not None:
        state.sessions.close(token)
        response.delete_cookie(state.cookie, httponly=True, samesite="strict")
    return SessionView(access="open" if state.service.keys.is_open else "keys")
