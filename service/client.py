"""A small client of the HTTP API over httpx: the command line uses it, and others may copy it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import httpx2

from hal.errors import CellError, ConfigError, DeviceUnavailable, Retry, detail_lines

DEFAULT_URL = "http://127.0.0.1:8460"
FINAL = ("succeeded", "failed", "cancelled")
STOP_WAIT_S = 1.0  # then the stop process is asked, which no work of the service delays


class ApiError(CellError):
    """A problem that the service answered with; `problem` holds the whole document."""

    def __init__(self, problem: dict[str, Any]) -> None:
        super().__init__(
            str(problem.get("detail", "the service refused")),
            hint=str(problem.get("hint", "see the log of the service")),
            **problem.get("details", {}),
        )
        self.problem = problem

    def for_people(self) -> str:
        """Several lines for a terminal."""
        lines = [f"{self.problem.get('title', 'Problem')}: {self.what}"]
        return "\n".join(
            [
                *lines,
                *detail_lines(self.details),
                f"  try    {self.hint}",
                f"  retry  {self.problem.get('retry', Retry.NEVER)}",
            ]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Client:
    """Talks to one service.

    Args:
        url: where it answers, e.g. `http://127.0.0.1:8460`.
        timeout_s: for one answer.
    """

    url: str = DEFAULT_URL
    timeout_s: float = 40.0

    def get(self, path: str) -> Any:
        """The JSON answer to a GET.

        Raises:
            ApiError: the service answered with a problem.
            ConfigError: the address is none, or something else answers there.
            DeviceUnavailable: nobody answers there.
        """
        return _json(self.fetch("GET", path))

    def post(self, path: str, body: Any = None, *, headers: dict[str, str] | None = None) -> Any:
        """The JSON answer to a POST; errors as for `get`."""
        return _json(self.fetch("POST", path, body, headers=headers))

    def stop(self) -> Any:
        """Latch the software stop: by the service or, when it does not answer at once, by its stop process.

        The stop process is looked for on the next port, where `serve` puts it; where `--stop-port` put it elsewhere, make a
        client of that address.

        Raises:
            ApiError: the service answered with a problem.
            DeviceUnavailable: neither of them answers.
        """
        url = self._address()
        try:
            return Client(url=self.url, timeout_s=STOP_WAIT_S).post("/v1/stop")
        except DeviceUnavailable as error:
            beside = url.copy_with(port=(url.port or 80) + 1)
            try:
                return Client(url=str(beside), timeout_s=STOP_WAIT_S).post("/v1/stop")
            except CellError:
                raise DeviceUnavailable(
                    f"{error.what}; nor does a stop process on the next port",
                    hint="use the hardware stop; or name the stop port, as `panelwright serve` printed it, with --url",
                ) from error

    def put(self, path: str, body: Any) -> Any:
        """The JSON answer to a PUT; errors as for `get`."""
        return _json(self.fetch("PUT", path, body))

    def fetch(self, method: str, path: str, body: Any = None, *, headers: dict[str, str] | None = None) -> bytes:
        """The raw answer; errors as for `get`."""
        with self._stream(method, path, body, headers or {}) as answer:
            return answer.read()

    def events(self, task_id: str) -> Iterator[dict[str, Any]]:
        """The events of a task as they come, until it ends. A lost connection is taken up where it broke."""
        seen = 0
        while True:
            for event in self._events(f"/v1/tasks/{task_id}/events", seen):
                seen = int(event["sequence"])
                yield event
            if self.get(f"/v1/tasks/{task_id}")["state"] in FINAL:
                return

    def _events(self, path: str, last: int) -> Iterator[dict[str, Any]]:
        with self._stream("GET", path, None, {"Last-Event-ID": str(last), "Accept": "text/event-stream"}) as answer:
            try:
                for event in httpx2.EventSource(answer):
                    yield json.loads(event.data)
            except httpx2.RequestError:
                return  # the caller looks whether the task has ended, and comes back if not

    @contextmanager
    def _stream(self, method: str, path: str, body: Any, headers: dict[str, str]) -> Iterator[httpx2.Response]:
        """An answer that is no problem, while it is being read; a connection that breaks then is a service that is gone."""
        url = self._address().join(path)
        # A proxy of the environment is for the world outside: a cell is reached directly.
        with httpx2.Client(timeout=self.timeout_s, trust_env=False) as connection:
            try:
                with connection.stream(method, url, json=body, headers=headers) as answer:
                    if answer.status_code >= httpx2.codes.BAD_REQUEST:
                        raise ApiError(_problem(answer.read(), answer.status_code))
                    yield answer
            except httpx2.RequestError as error:
                raise self._lost(error) from error

    def _address(self) -> httpx2.URL:
        try:
            url = httpx2.URL(self.url if "//" in self.url else f"http://{self.url}")  # as curl takes it
        except httpx2.InvalidURL:
            url = httpx2.URL("")
        if not url.host or url.scheme != "http":
            raise ConfigError(f"{self.url!r} is no address of a service", hint=f"for example {DEFAULT_URL}")
        return url

    def _lost(self, error: Exception) -> DeviceUnavailable:
        why = str(error).partition("] ")[2] or str(error) or type(error).__name__  # without the number of the error
        return DeviceUnavailable(
            f"no panelwright answers at {self.url}: {why}",
            hint="start one with `panelwright serve`, or name its address with --url",
        )


def _json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        raise ConfigError(
            "what answers there is no panelwright", hint="`panelwright serve` prints the address of its API"
        ) from None


def _problem(data: bytes, status: int) -> dict[str, Any]:
    try:
        problem = json.loads(data)
    except ValueError:
        problem = None
    return problem if isinstance(problem, dict) else {"title": "Problem", "detail": f"the service answered {status}"}
