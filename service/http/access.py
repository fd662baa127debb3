"""The one check of every call: who asks (a key or a session), and whether the role permits it."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, WebSocketException
from starlette.requests import HTTPConnection

from service.access.actor import act_as
from service.access.keys import Keys, Role
from service.errors import Forbidden, KeysUnusable, Unauthenticated
from service.http.guard import PROXIED
from service.http.permissions import row_of
from service.http.state import AppState

POLICY_VIOLATION = 1008
HOW = "send `Authorization: Bearer KEY`, or log in at /login.html"


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """Who asks: name, role and hash of a key. `name` is None while the service has no keys."""

    name: str | None
    role: Role
    key_hash: str = ""


ANYBODY = Caller(name=None, role=Role.MAINTAINER)


async def check_access(connection: HTTPConnection) -> None:
    """Check the key and the role of a request; a dependency of every route.

    Raises:
        Unauthenticated, Forbidden: the key is missing or not valid, or its role does not permit this call.
        KeysUnusable: the file of keys cannot be used.
        WebSocketException: any of these, for a WebSocket.
    """
    state: AppState = connection.app.state.panelwright
    is_socket = connection.scope["type"] == "websocket"
    method = "WS" if is_socket else connection.scope["method"]
    row = row_of(method, connection.scope["route"].path)
    if row.role is None or (row.is_free_here and is_here(connection)):
        _remember(connection, _quietly(state, connection))
        return
    try:
        caller = caller_of(state, connection)
        if caller is None and not is_socket:
            raise Unauthenticated("this service needs a key", hint=HOW)
        if caller is not None:  # a WebSocket may still send its key as its first message
            check_role(caller, row.role)
    except (Unauthenticated, Forbidden, KeysUnusable) as error:
        if is_socket:
            raise WebSocketException(POLICY_VIOLATION, error.what) from None
        raise
    _remember(connection, caller)


def check_role(caller: Caller, needed: Role) -> None:
    """Raise `Forbidden` unless the caller's role permits what needs `needed`."""
    if not caller.role.permits(needed):
        raise Forbidden(
            f"the key {caller.name!r} has the role {caller.role}; this call needs {needed}",
            hint="use another key; a maintainer of this machine adds one with `panelwright keys add`",
        )


def caller_of(state: AppState, connection: HTTPConnection) -> Caller | None:
    """Return who asks; None when there are keys and the request has none.

    Raises:
        Unauthenticated: the key or the session is not valid, or a page of another origin used the session.
        KeysUnusable: the file of keys cannot be used.
    """
    keys = state.service.keys.now()
    if keys.is_open:
        return ANYBODY
    header = connection.headers.get("authorization")
    if header is not None:
        scheme, _, secret = header.partition(" ")
        if scheme.lower() != "bearer":
            raise Unauthenticated("the Authorization header is not a bearer key", hint=HOW)
        return caller_with(keys, secret.strip())
    token = connection.cookies.get(state.cookie)
    if token is None:
        return None
    is_writing = connection.scope["type"] == "websocket" or connection.scope["method"] not in ("GET", "HEAD")
    if is_writing and connection.headers.get("origin") not in state.origins:  # the guard lets a missing origin pass
        raise Unauthenticated("a session is valid only for the page of this service", hint=HOW)
    key = state.sessions.find(token, keys)
    if key is None:
        raise Unauthenticated("the session has ended", hint="log in again at /login.html")
    return Caller(name=key.name, role=key.role, key_hash=key.sha256)


def caller_with(keys: Keys, secret: str) -> Caller:
    """Return the caller with this key.

    Raises:
        Unauthenticated: no active key has this secret.
    """
    key = keys.find(secret)
    if key is None:
        raise Unauthenticated("the key is not valid: unknown, revoked or expired", hint="ask for a new key")
    return Caller(name=key.name, role=key.role, key_hash=key.sha256)


def is_valid_still(state: AppState, caller: Caller) -> bool:
    """Return whether a stream that this caller began may tell more: its key was neither revoked nor has it expired."""
    try:
        keys = state.service.keys.recent()
    except KeysUnusable:
        return False
    key = keys.by_hash.get(caller.key_hash)
    return keys.is_open if caller.name is None else key is not None and key.is_active(keys.now_s)


async def still_may(connection: HTTPConnection) -> Callable[[], bool]:
    """Return what a stream asks before it tells something; a dependency."""
    state: AppState = connection.app.state.panelwright
    caller: Caller = connection.state.caller
    return lambda: is_valid_still(state, caller)


StillMay = Annotated[Callable[[], bool], Depends(still_may)]


def is_here(connection: HTTPConnection) -> bool:
    """Return whether a request comes from this machine, and not through a proxy."""
    if connection.client is None or connection.scope.get(PROXIED, False):
        return False
    try:
        return ipaddress.ip_address(connection.client.host).is_loopback
    except ValueError:
        return False


def _quietly(state: AppState, connection: HTTPConnection) -> Caller | None:
    """Return who asks where nobody needs a key; a bad key is no error there."""
    try:
        return caller_of(state, connection)
    except (Unauthenticated, KeysUnusable):
        return None


def _remember(connection: HTTPConnection, caller: Caller | None) -> None:
    connection.state.caller = caller
    act_as(caller.name if caller is not None else None)
