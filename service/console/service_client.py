"""Asks the HTTP API without waiting in the event loop; an error becomes a sentence for people."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from http.cookiejar import CookieJar, DefaultCookiePolicy
from typing import Any

import httpx2
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from hal.errors import DeviceUnavailable
from service.client import ApiError, document, trusting_only
from service.console.texts import say
from service.processes.client_host import CONSOLE_HEADER

TIMEOUT_S = 40.0
QUICK_S = 3.0


class ServiceClient:
    """A client of one service.

    Args:
        url: its address, for example `http://127.0.0.1:8460`.
        ca: the service's certificate, for an address with https.
        secret: proves to the service that its own console asks; None for another program.
        transport: carries the requests; None for the network.
    """

    def __init__(
        self,
        url: str,
        *,
        ca: str | None = None,
        secret: str | None = None,
        transport: httpx2.AsyncBaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._headers: Mapping[str, str] = {} if secret is None else {CONSOLE_HEADER: secret}
        self._tls = None if ca is None else trusting_only(ca)
        self._http = httpx2.AsyncClient(
            base_url=self.url,
            timeout=TIMEOUT_S,
            trust_env=False,
            verify=True if self._tls is None else self._tls,
            transport=transport,
            # It keeps no cookie of an answer: the session of one person must never go out with the request of another.
            cookies=CookieJar(policy=DefaultCookiePolicy(allowed_domains=[])),
        )

    def in_session(self, cookie: str) -> ServiceClient:
        """Return a client over the same connections in the session of one person; `cookie` is its name and value.

        The service accepts a session only from its own origin. `OwnPageOnly` has checked the origin of the browser's request.
        """
        one = copy.copy(self)
        one._headers = {**self._headers, "Cookie": cookie, "Origin": self.url}
        return one

    async def get(self, path: str, *, timeout_s: float = TIMEOUT_S) -> Any:
        """Return the JSON answer to a GET request.

        Raises:
            ApiError: the service answered with a problem.
            DeviceUnavailable: it does not answer.
        """
        return document(await self.fetch("GET", path, timeout_s=timeout_s), self.url)

    async def post(self, path: str, body: Any = None) -> Any:
        """Return the JSON answer to a POST request; errors as for `get`."""
        return document(await self.fetch("POST", path, body), self.url)

    async def fetch(self, method: str, path: str, body: Any = None, *, timeout_s: float = TIMEOUT_S) -> bytes:
        """Return the bytes of an answer; errors as for `get`."""
        answer = await self.answer(method, path, body, timeout_s=timeout_s)
        is_told = path == "/readyz" and answer.status_code == httpx2.codes.SERVICE_UNAVAILABLE
        if answer.status_code >= httpx2.codes.BAD_REQUEST and not is_told:
            raise ApiError(_problem(answer.content, answer.status_code, self.url))
        return answer.content

    async def answer(
        self,
        method: str,
        path: str,
        body: Any = None,
        *,
        content: bytes | None = None,
        media: str | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> httpx2.Response:
        """Return an answer as it came, also a problem.

        Args:
            content, media: a body as it is, with its media type, in place of `body`.

        Raises:
            DeviceUnavailable: the service does not answer.
        """
        headers = self._headers if media is None else {**self._headers, "Content-Type": media}
        try:
            return await self._http.request(
                method, path, json=body, content=content or None, timeout=timeout_s, headers=headers
            )
        except httpx2.RequestError as error:
            raise DeviceUnavailable(say("service.silent"), hint=say("service.silent.hint")) from error

    async def events(self, task_id: str) -> AsyncIterator[dict[str, Any]]:
        """Yield the events of a task from its beginning until it ends or the connection is lost."""
        headers = {**self._headers, "Accept": "text/event-stream"}
        try:
            async with self._http.stream("GET", f"/v1/tasks/{task_id}/events", headers=headers, timeout=None) as answer:
                async for event in httpx2.EventSource(answer):
                    yield document(event.data, self.url)
        except httpx2.RequestError:
            return

    async def robot(self) -> AsyncGenerator[dict[str, Any]]:
        """Yield the state of the robot, 20 times a second, until the connection is lost; problems are left out."""
        address = f"{self.url.replace('http', 'ws', 1)}/v1/stream"
        with contextlib.suppress(WebSocketException, OSError, TimeoutError):
            async with connect(address, additional_headers=self._headers, proxy=None, ssl=self._tls) as stream:
                async for text in stream:
                    sample = document(text, self.url)
                    if "problem" not in sample:
                        yield sample

    async def close(self) -> None:
        """Close its connections."""
        await self._http.aclose()


def _problem(data: bytes, status: int, url: str) -> dict[str, Any]:
    try:
        problem = document(data, url)
    except ValueError:
        problem = None
    return (
        problem if isinstance(problem, dict) else {"title": "Problem", "detail": say("service.status", status=status)}
    )
