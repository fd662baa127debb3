"""Refuses query parameters that a route does not have, because a misspelt one would otherwise go unnoticed."""

from __future__ import annotations

from difflib import get_close_matches

from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from hal.errors import InvalidRequest
from service.http.problems import path_of

NEVER_REFUSED = ("/v1/stop",)  # a stop works with any parameters


async def check_query(connection: HTTPConnection) -> None:
    """Check the query parameters of a request; a dependency of every route.

    Raises:
        InvalidRequest: there is an unknown parameter; the error names it and the parameters of the route.
    """
    route = connection.scope["route"]
    if not isinstance(route, APIRoute) or route.path in NEVER_REFUSED:
        return
    known = sorted(field.alias for field in route.dependant.query_params)
    for name in connection.query_params:
        if name not in known:
            path = path_of(("query", name))
            raise InvalidRequest(f"{path}: unknown parameter", hint=_hint(name, known), parameter=path, known=known)


def _hint(name: str, known: list[str]) -> str:
    near = get_close_matches(name, known, n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"parameters of this call: {', '.join(known)}" if known else "this call has no query parameters"
