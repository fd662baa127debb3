"""Serves the web page, and answers paths without a route: 405 if another method exists, else 404."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.routing import BaseRoute, Match
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

METHODS = ("DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT")
FILE_METHODS = ("GET", "HEAD")


class Page(StaticFiles):
    """The files of the page, mounted after all routes.

    Args:
        folder: the folder with the files.
        routes: all routes of the application, which are searched for other methods of a path.
    """

    def __init__(self, folder: Path, routes: Sequence[BaseRoute]) -> None:
        super().__init__(directory=folder, html=True)
        self._routes = routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send a file, or raise an `HTTPException`, which becomes a problem."""
        allowed = self._methods_of_routes(scope)
        if not allowed and scope["method"] not in FILE_METHODS:
            allowed = FILE_METHODS if self._is_file(scope) else ()
            if not allowed:
                raise HTTPException(404)
        if allowed:
            raise HTTPException(405, headers={"Allow": ", ".join(allowed)})
        await super().__call__(scope, receive, send)

    def _is_file(self, scope: Scope) -> bool:
        try:
            return self.lookup_path(self.get_path(scope))[1] is not None
        except (OSError, ValueError):  # the name is too long or has a zero byte
            return False

    def _methods_of_routes(self, scope: Scope) -> tuple[str, ...]:
        routes = [route for route in self._routes if getattr(route, "app", None) is not self]
        asked = [{**scope, "method": method} for method in METHODS]
        return tuple(a["method"] for a in asked if any(route.matches(a)[0] is Match.FULL for route in routes))
