"""A small client of the HTTP API, standard library only: the command line uses it, and others may copy it."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

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
        host, port = self._address()
        try:
            return Client(url=self.url, timeout_s=STOP_WAIT_S).post("/v1/stop")
        except DeviceUnavailable as error:
            name = f"[{host}]" if ":" in host else host
            try:
                return Client(url=f"http://{name}:{(port or 80) + 1}", timeout_s=STOP_WAIT_S).post("/v1/stop")
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
        connection, answer = self._ask(method, path, body, headers or {})
        try:
            data = answer.read()
        except (OSError, http.client.HTTPException) as error:  # it may end in the middle of its answer
            raise self._lost(error) from error
        finally:
            connection.close()
        if answer.status >= 400:
            raise ApiError(_problem(data, answer.status))
        return data

    def events(self, task_id: str) -> Iterator[dict[str, Any]]:
        """The events of a task as they come, until it ends. A lost connection is taken up where it broke."""
        seen = 0
        while True:
            for event in self._stream(f"/v1/tasks/{task_id}/events", seen):
                seen = int(event["sequence"])
                yield event
            if self.get(f"/v1/tasks/{task_id}")["state"] in FINAL:
                return

    def _stream(self, path: str, last: int) -> Iterator[dict[str, Any]]:
        connection, answer = self._ask("GET", path, None, {"Last-Event-ID": str(last)})
        try:
            if answer.status >= 400:
                raise ApiError(_problem(answer.read(), answer.status))
            for line in answer:
                if line.startswith(b"data: "):
                    yield json.loads(line[6:])
        except (OSError, http.client.HTTPException):
            return  # the caller looks whether the task has ended, and comes back if not
        finally:
            connection.close()

    def _ask(
        self, method: str, path: str, body: Any, headers: dict[str, str]
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        connection = http.client.HTTPConnection(*self._address(), timeout=self.timeout_s)
        data = None if body is None else json.dumps(body)
        typed = headers if data is None else {**headers, "Content-Type": "application/json"}
        try:
            connection.request(method, path, data, typed)
            return connection, connection.getresponse()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            raise self._lost(error) from error

    def _address(self) -> tuple[str, int | None]:
        parts = urlsplit(self.url if "//" in self.url else f"//{self.url}", scheme="http")  # as curl takes it
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if host is None or parts.scheme != "http":
            raise ConfigError(f"{self.url!r} is no address of a service", hint=f"for example {DEFAULT_URL}")
        return host, port

    def _lost(self, error: Exception) -> DeviceUnavailable:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
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
