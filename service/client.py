"""A small client of the HTTP API; the command line uses it, and other programs may copy it."""

from __future__ import annotations

import json
import re
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx2

from hal.errors import CellError, ConfigError, DeviceUnavailable, Retry, detail_lines

DEFAULT_URL = "http://127.0.0.1:8460"
# Commands that address a service; those that name their service or their own cell, or only read files, do not count.
TALKING = re.compile(
    r"`panelwright (?:devices(?! (?:record|replay)\b)|task|stop|inspect|set|learn|history|foxglove|alarms|rounds|review|certify"
    r"|mission (?:run|resume)|calibrate (?:camera|hand-eye|scanner|tool|list))(?![\w-])"
    r"(?![^`]*--(?:url|cell)\b)[^`]*(?=`)"
)
FINAL = ("succeeded", "failed", "cancelled")
SEE_LOG = "see the log of the service"
STOP_WAIT_S = 1.0  # after this, the stop process is asked, which other work cannot delay


def for_service(text: str, url: str) -> str:
    """Return a hint whose commands address the service at `url`: `--url` is added where that is not the default.

    Commands stand between back quotes; one that names its service or its cell is left as it is.
    """
    url = url.rstrip("/")
    return text if url == DEFAULT_URL else TALKING.sub(rf"\g<0> --url {url}", text)


def trusting_only(certificate: str | Path) -> ssl.SSLContext:
    """Return what lets a process of the service trust this certificate and no other, whatever names it is for.

    They ask the service at an address of their own machine, which a certificate for the plant does not have.
    """
    context = ssl.create_default_context(cafile=certificate)
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    return context


def document(data: str | bytes, url: str) -> Any:
    """Return a JSON document of the service at `url`, with hints whose commands address it; see `for_service`.

    Raises:
        ValueError: the text is not JSON.
    """

    def addressed(found: dict[str, Any]) -> dict[str, Any]:
        if isinstance(hint := found.get("hint"), str):
            found["hint"] = for_service(hint, url)
        return found

    return json.loads(data, object_hook=addressed)


class ApiError(CellError):
    """An error that the service returned as a problem document, which `problem` holds whole."""

    def __init__(self, problem: dict[str, Any]) -> None:
        super().__init__(
            str(problem.get("detail", "the service refused")),
            hint=str(problem.get("hint", SEE_LOG)),
            **problem.get("details", {}),
        )
        self.problem = problem

    def for_people(self) -> str:
        """Return the error as several lines for a terminal."""
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
    """A client of one service.

    Args:
        url: address of the service, e.g. `http://127.0.0.1:8460`.
        timeout_s: the longest wait for one answer.
        key: the key to send, for a service that has keys.
        ca: file with the certificate to trust, for an https address; by default those of the system.
        is_lasting: whether the service goes on after this client, so that hints may name its address.
    """

    url: str = DEFAULT_URL
    timeout_s: float = 40.0
    key: str | None = field(default=None, repr=False)
    ca: Path | None = None
    is_lasting: bool = True

    @property
    def _hint_url(self) -> str:
        return self.url if self.is_lasting else DEFAULT_URL

    def addressed(self, hint: str) -> str:
        """Return a hint whose commands address this service; see `for_service`."""
        return for_service(hint, self._hint_url)

    def get(self, path: str) -> Any:
        """Return the JSON answer to a GET request.

        Raises:
            ApiError: the service answered with a problem.
            ConfigError: the address is not valid, or another program answers there.
            DeviceUnavailable: nothing answers there.
        """
        return self._json(self.fetch("GET", path))

    def post(self, path: str, body: Any = None, *, headers: dict[str, str] | None = None) -> Any:
        """Return the JSON answer to a POST request; errors as for `get`."""
        return self._json(self.fetch("POST", path, body, headers=headers))

    def stop(self, level: str = "off") -> Any:
        """Latch the software stop through the service or, when that does not answer at once, through its stop process.

        The stop process is expected on the next port, which is the default of `serve`; if `--stop-port` chose another, make a
        client for that address.

        Raises:
            ApiError: the service answered with a problem.
            DeviceUnavailable: neither the service nor the stop process answers.
        """
        url = self._address()
        try:
            return replace(self, timeout_s=STOP_WAIT_S).post(f"/v1/stop?level={level}")
        except DeviceUnavailable as error:
            beside = url.copy_with(
                scheme="http", port=(url.port or 80) + 1
            )  # the stop port has no TLS and needs no key
            try:
                return Client(url=str(beside), timeout_s=STOP_WAIT_S).post(f"/v1/stop?level={level}")
            except CellError:
                raise DeviceUnavailable(
                    f"{error.what}; nor does a stop process on the next port",
                    hint="use the hardware stop; or name the stop port, as `panelwright serve` printed it, with --url",
                ) from error

    def put(self, path: str, body: Any) -> Any:
        """Return the JSON answer to a PUT request; errors as for `get`."""
        return self._json(self.fetch("PUT", path, body))

    def fetch(self, method: str, path: str, body: Any = None, *, headers: dict[str, str] | None = None) -> bytes:
        """Return the raw bytes of an answer; errors as for `get`."""
        with self._stream(method, path, body, headers or {}) as answer:
            return answer.read()

    def events(self, task_id: str) -> Iterator[dict[str, Any]]:
        """Yield the events of a task as they come until it ends; a lost connection is resumed after the last event."""
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
                    yield document(event.data, self._hint_url)
            except httpx2.RequestError:
                return  # the caller checks whether the task has ended, and calls again if not

    @contextmanager
    def _stream(self, method: str, path: str, body: Any, headers: dict[str, str]) -> Iterator[httpx2.Response]:
        """Open a successful answer for reading; a connection that breaks meanwhile raises `DeviceUnavailable`."""
        url = self._address().join(path)
        # Ignore proxies of the environment, because a cell is reached directly.
        with httpx2.Client(timeout=self.timeout_s, trust_env=False, verify=self._trusted(url)) as connection:
            try:
                with connection.stream(method, url, json=body, headers={**self._own_headers(), **headers}) as answer:
                    if answer.status_code >= httpx2.codes.BAD_REQUEST:
                        raise ApiError(self._problem(answer.read(), answer.status_code))
                    yield answer
            except httpx2.RequestError as error:
                raise self._lost(error) from error

    def _json(self, data: bytes) -> Any:
        try:
            return document(data, self._hint_url)
        except ValueError:
            raise ConfigError(
                "another program answers there", hint="`panelwright serve` prints the address of its API"
            ) from None

    def _problem(self, data: bytes, status: int) -> dict[str, Any]:
        try:
            problem = document(data, self._hint_url)
        except ValueError:
            problem = None
        return (
            problem if isinstance(problem, dict) else {"title": "Problem", "detail": f"the service answered {status}"}
        )

    def _address(self) -> httpx2.URL:
        try:
            url = httpx2.URL(self.url if "//" in self.url else f"http://{self.url}")  # http is the default, as for curl
        except httpx2.InvalidURL:
            url = httpx2.URL("")
        if not url.host or url.scheme not in ("http", "https"):
            raise ConfigError(f"{self.url!r} is not the address of a service", hint=f"for example {DEFAULT_URL}")
        return url

    def _own_headers(self) -> dict[str, str]:
        return {} if self.key is None else {"Authorization": f"Bearer {self.key}"}

    def _trusted(self, url: httpx2.URL) -> ssl.SSLContext | bool:
        """Return what httpx needs to check the service's certificate.

        Raises:
            ConfigError: the file of the trusted certificate cannot be used.
        """
        if url.scheme != "https":
            return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # unused; by default all authorities are loaded in 25 ms
        if self.ca is None:
            return True
        try:
            return ssl.create_default_context(cafile=self.ca)
        except OSError as error:  # also of a file without a certificate
            raise ConfigError(f"{self.ca} is no certificate: {error}", hint="a file in PEM format") from error

    def _lost(self, error: Exception) -> DeviceUnavailable:
        why = str(error).partition("] ")[2] or str(error) or type(error).__name__  # without the error number
        return DeviceUnavailable(
            f"no panelwright service answers at {self.url}: {why}",
            hint=f"start one with `panelwright serve{_port_option(self.url)}`, or name its address with --url",
        )


def _port_option(url: str) -> str:
    """Return the option with which `serve` listens at `url`; empty for the default."""
    port = httpx2.URL(url if "//" in url else f"http://{url}").port
    return "" if port in (None, httpx2.URL(DEFAULT_URL).port) else f" --port {port}"
