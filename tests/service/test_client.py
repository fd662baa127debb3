"""Tests of the client of the HTTP API: with a broken, a foreign and no service, and stopping by it."""

from __future__ import annotations

import json
import socket
import ssl
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar, cast

import httpx2
import pytest

from hal.errors import ConfigError, DeviceUnavailable
from service.client import DEFAULT_URL, ApiError, Client, for_service
from service.commands.own_cell import run_task
from service.processes.latch import Latch
from service.processes.stop_host import InlineStop, bound_socket


@pytest.fixture
def hung() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Yield two neighbouring ports: one of a service that accepts connections and never answers, the next one free."""
    while True:
        service = bound_socket("127.0.0.1", 0)
        try:
            beside = bound_socket("127.0.0.1", service.getsockname()[1] + 1)
            break
        except ConfigError:
            service.close()
    yield service, beside
    service.close()
    beside.close()


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.client.STOP_WAIT_S", 0.3)


def _client_of(service: socket.socket) -> Client:
    return Client(url=f"http://127.0.0.1:{service.getsockname()[1]}")


def test_a_service_that_hangs_does_not_hinder_a_stop(hung: tuple[socket.socket, socket.socket], tmp_path: Path) -> None:
    service, beside = hung
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    stop = InlineStop(latch, beside, ())
    try:
        assert _client_of(service).stop()["is_latched"]
        assert latch.is_set()
    finally:
        stop.close()
        latch.close()


def test_where_nobody_stops_a_person_must(hung: tuple[socket.socket, socket.socket]) -> None:
    service, beside = hung
    beside.close()
    with pytest.raises(DeviceUnavailable, match="nor does a stop process") as refusal:
        _client_of(service).stop()
    assert "hardware stop" in refusal.value.hint


class Interrupted:
    """Client whose user presses Ctrl-C as soon as the task runs."""

    def __init__(self) -> None:
        self.posted: list[str] = []

    def post(self, path: str, _body: Any = None) -> Any:
        self.posted.append(path)
        return {"id": "7", "state": "cancelled"}

    def get(self, _path: str) -> Any:
        raise KeyboardInterrupt


def test_ctrl_c_ends_a_task_on_a_running_service_too(capsys: pytest.CaptureFixture[str]) -> None:
    client = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        run_task(cast("Client", client), "/v1/calibrations", {"what": "tool"})
    assert client.posted == ["/v1/calibrations", "/v1/tasks/7/cancel"]
    assert "the arm stops" in capsys.readouterr().out


class Scripted(BaseHTTPRequestHandler):
    """Service that breaks the event stream after the second event and ends the task before the rest is requested."""

    resumed_at: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        if self.path.endswith("/events"):
            self.resumed_at.append(self.headers["Last-Event-ID"])
            first = int(self.headers["Last-Event-ID"]) + 1
            events = "".join(f'id: {k}\nevent: progress\ndata: {{"sequence": {k}}}\n\n' for k in (first, first + 1))
            self._answer(200, "text/event-stream", events.encode(), length=len(events) + (100 if first == 1 else 0))
        elif self.path == "/v1/tasks/7":
            state = "succeeded" if len(self.resumed_at) > 1 else "running"
            self._answer(200, "application/json", json.dumps({"state": state}).encode())
        elif self.path == "/v1/page":
            self._answer(200, "text/html", b"<p>something else</p>")
        else:
            problem = {
                "title": "Busy",
                "detail": "17 tasks wait",
                "hint": "wait",
                "retry": "safe",
                "details": {"n": 17},
            }
            self._answer(503, "application/problem+json", json.dumps(problem).encode())

    def _answer(self, status: int, media: str, data: bytes, *, length: int | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", media)
        self.send_header("Content-Length", str(len(data) if length is None else length))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_args: object) -> None:
        """Do not log."""


@pytest.fixture
def scripted() -> Iterator[Client]:
    Scripted.resumed_at.clear()
    with ThreadingHTTPServer(("127.0.0.1", 0), Scripted) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield Client(url=f"127.0.0.1:{server.server_port}")
        server.shutdown()
        thread.join()


def test_a_broken_event_stream_is_taken_up_where_it_broke(scripted: Client) -> None:
    assert [event["sequence"] for event in scripted.events("7")] == [1, 2, 3, 4]
    assert Scripted.resumed_at == ["0", "2"]


def test_a_problem_is_an_error_with_its_hint_and_details(scripted: Client) -> None:
    with pytest.raises(ApiError, match="17 tasks wait") as refusal:
        scripted.get("/v1/tasks")
    assert (refusal.value.hint, refusal.value.details["n"]) == ("wait", 17)
    assert "retry  safe" in refusal.value.for_people()


def test_another_server_at_the_address_is_told_apart_from_none(scripted: Client) -> None:
    with pytest.raises(ConfigError, match="another program answers"):
        scripted.get("/v1/page")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound without a listener
        with pytest.raises(
            DeviceUnavailable, match=r"no panelwright service answers at .*: Connection refused"
        ) as refusal:
            Client(url=f"http://127.0.0.1:{unused.getsockname()[1]}").get("/v1/info")
    assert "--url" in refusal.value.hint


@pytest.mark.parametrize("url", ["", "ftp://localhost", "http://", "http://[::1", "ftp://localhost:1"])
def test_what_is_no_address_is_refused_before_anything_is_sent(url: str) -> None:
    with pytest.raises(ConfigError, match="not the address of a service"):
        Client(url=url).get("/v1/info")


def test_a_proxy_of_the_environment_is_not_asked(scripted: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:1")
    assert scripted.get("/v1/tasks/7")["state"] == "running"


AT = "http://127.0.0.1:9000"


@pytest.mark.parametrize(
    ("hint", "addressed"),
    [
        ("run `panelwright devices` and look", f"run `panelwright devices --url {AT}` and look"),
        ("then `panelwright stop --reset`, later", f"then `panelwright stop --reset --url {AT}`, later"),
        ("`panelwright calibrate camera --device c`", f"`panelwright calibrate camera --device c --url {AT}`"),
        ("`panelwright calibrate tip` and `panelwright mission check m`", None),
        ("`panelwright mission run m`", f"`panelwright mission run m --url {AT}`"),
        ("`panelwright task cancel t1 --url http://b`", "`panelwright task cancel t1 --url http://b`"),
        ("`panelwright devices read x --cell c.toml`", "`panelwright devices read x --cell c.toml`"),
        ("`panelwright devices record x out`; `panelwright doctor`", None),
        (
            "`panelwright task list` or `panelwright stop --url http://b`",
            f"`panelwright task list --url {AT}` or `panelwright stop --url http://b`",
        ),
    ],
)
def test_a_command_in_a_hint_names_the_service_at_hand(hint: str, addressed: str | None) -> None:
    assert for_service(hint, AT + "/") == (hint if addressed is None else addressed)
    assert for_service(hint, DEFAULT_URL) == hint
    assert Client(url=AT, is_lasting=False).addressed(hint) == hint


PROBLEM = {"detail": "silent", "hint": "run `panelwright devices`"}


class Refusing(BaseHTTPRequestHandler):
    """Service that answers with a problem, as such or in a list."""

    def do_GET(self) -> None:
        body = json.dumps([PROBLEM] if self.path == "/v1/devices" else PROBLEM).encode()
        self.send_response(200 if self.path == "/v1/devices" else 503)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Do not log."""


def test_the_hint_of_a_problem_names_the_service_that_was_asked() -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        url = f"http://127.0.0.1:{server.server_port}"
        with pytest.raises(ApiError) as refused:
            Client(url=url).get("/v1/panel")
        listed = Client(url=url).get("/v1/devices")
        server.shutdown()
    assert refused.value.hint == listed[0]["hint"] == f"run `panelwright devices --url {url}`"


def test_nobody_at_another_port_is_answered_with_that_port() -> None:
    with pytest.raises(DeviceUnavailable) as refused:
        Client(url="http://127.0.0.1:9").get("/readyz")
    assert "`panelwright serve --port 9`" in refused.value.hint


def test_a_request_without_tls_loads_no_authorities(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take 25 ms of the processor for each request, which a program that polls would not leave to the cell."""

    contexts: list[ssl.SSLContext | bool] = []

    def recorded(**given: Any) -> httpx2.Client:
        contexts.append(given["verify"])
        return connect(**given)

    connect = httpx2.Client
    monkeypatch.setattr(httpx2, "Client", recorded)
    with pytest.raises(DeviceUnavailable):
        Client(url="http://127.0.0.1:9", timeout_s=2.0).get("/readyz")
    assert [one.cert_store_stats()["x509_ca"] for one in contexts if isinstance(one, ssl.SSLContext)] == [0]
