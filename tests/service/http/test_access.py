"""Every call against every role: the table is complete, and the service answers as the table says."""

from __future__ import annotations

import inspect
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest
import websockets.exceptions
from fastapi.routing import APIRoute, APIWebSocketRoute
from starlette.routing import BaseRoute
from websockets.sync.client import connect

from hal.config import load_cell
from service.access.keys import Role
from service.core import Service
from service.http.app import create_app
from service.http.guard import Allowed, RequestGuard
from service.http.permissions import TABLE, Asks, row_of
from service.operations import OPERATIONS
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.history.test_store import reading

ROLES = (None, *Role)
ALARM_DEEDS = ("acknowledge", "comment", "shelve", "unshelve", "out-of-service", "in-service")
PLACE = {
    "{alarm}": "none.high",
    "{object}": "none",
    "{crop}": "none",
    "{name}": "arm",
    "{task_id}": "none",
    "{image_id}": "0" * 24,
    "{mission}": "none",
    "{group}": "kinds",
    "{round}": "none",
    "{reading}": "1",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarded:
    """A service with a key for each role."""

    server: Panelwright
    keys: dict[Role, str]

    def headers(self, role: Role | None) -> dict[str, str]:
        return {} if role is None else {"Authorization": f"Bearer {self.keys[role]}"}

    def rows(self, kind: str) -> list[dict[str, Any]]:
        return [record.data for record in self.server.service.journal.records(kinds=(kind,))]


@pytest.fixture(scope="module")
def guarded(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True)
    server = Panelwright(load_cell(write_module_cell(robot=True)), options, operations=OPERATIONS)
    book, commit = server.service.keys, server.service.commit
    keys = {role: book.add(f"the-{role}", role, valid_s=None, commit=commit) for role in Role}
    server.start()
    yield Guarded(server=server, keys=keys)
    server.close()


@pytest.fixture
def http(guarded: Guarded) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=guarded.server.url, timeout=10.0, trust_env=False) as client:
        yield client


def calls_of(routes: Iterable[BaseRoute]) -> set[str]:
    """Return all calls of routes and of the routers among them, as the table names them."""
    found = set()
    for route in routes:
        inner = getattr(route, "original_router", None)
        if inner is not None:
            found |= calls_of(inner.routes)
        if isinstance(route, APIRoute):
            found |= {f"{method} {route.path}" for method in route.methods}
        if isinstance(route, APIWebSocketRoute):
            found.add(f"WS {route.path}")
    return found


def test_every_call_has_a_row_and_every_row_a_call(write_cell: WriteCell, tmp_path: Path) -> None:
    service = Service(load_cell(write_cell(robot=True)), OPERATIONS, runs_dir=tmp_path / "runs", inline=True)
    try:
        allowed = Allowed(hosts=frozenset(), origins=frozenset())
        guard = create_app(service, allowed=allowed, stop_url="")
        assert isinstance(guard, RequestGuard)
        assert calls_of(guard.inner.routes) == set(TABLE), (
            "add the call to service/http/permissions.py, or take its row out"
        )
    finally:
        service.close()


def dependencies_of(routes: Iterable[BaseRoute]) -> set[Callable[..., Any]]:
    """Return everything that runs before the calls of routes."""
    found: set[Callable[..., Any]] = set()
    for route in routes:
        inner = getattr(route, "original_router", None)
        waiting = [] if not isinstance(route, APIRoute) else list(route.dependant.dependencies)
        waiting += [] if inner is None else [one for each in inner.routes for one in each.dependant.dependencies]
        while waiting:
            one = waiting.pop()
            found |= {one.call}
            waiting += one.dependencies
    return found


def test_no_request_waits_for_a_free_thread_before_its_call(write_cell: WriteCell, tmp_path: Path) -> None:
    service = Service(load_cell(write_cell(robot=True)), OPERATIONS, runs_dir=tmp_path / "runs", inline=True)
    try:
        guard = create_app(service, allowed=Allowed(hosts=frozenset(), origins=frozenset()), stop_url="")
        assert isinstance(guard, RequestGuard)
        calls = dependencies_of(guard.inner.routes)
        assert len(calls) > 5
        assert {call.__name__ for call in calls if not inspect.iscoroutinefunction(call)} == set()
    finally:
        service.close()


def test_a_call_without_a_row_needs_a_maintainer() -> None:
    assert row_of("POST", "/v1/forgotten").role is Role.MAINTAINER


def test_calls_that_change_something_ask_the_lease_or_say_why_not() -> None:
    free = {call for call, row in TABLE.items() if row.asks is Asks.NOTHING and not call.startswith(("GET ", "WS "))}
    assert free == {
        "POST /v1/stop",  # ending is always allowed
        "POST /v1/speed/reduce",  # so is making the arm slow
        "POST /v1/tasks/{task_id}/cancel",
        "POST /v1/session",  # about the caller alone
        "DELETE /v1/session",
        "POST /v1/knowledge/outline",  # writes nothing
        "POST /v1/read",
        "POST /v1/read-photograph",
        "POST /v1/review/{reading}",  # about the past
        "POST /v1/mission-files/check",  # writes nothing
        "PUT /v1/mission-files/{mission}",  # about later: a mission that runs has read its files
        "PUT /v1/rounds/{round}",  # about later: a round waits while somebody holds the lease
        "DELETE /v1/rounds/{round}",
        "PUT /v1/limits/{object}",  # about alarms, for those who watch
        "DELETE /v1/limits/{object}",
        *(f"POST /v1/alarms/{{alarm}}/{deed}" for deed in ALARM_DEEDS),  # for those who watch, whoever moves the arm
    }


def asked(http: httpx2.Client, call: str, headers: dict[str, str]) -> int:
    """Send a call with a body that no call accepts, so that nothing happens; returns the status."""
    method, _, path = call.partition(" ")
    path = re.sub(r"\{\w+\}", lambda found: PLACE[found[0]], path)
    media = "image/png" if call == "POST /v1/images" else "application/json"
    content = b"[" if method in ("POST", "PUT") else None
    if method == "WS":
        return socket_status(http, headers)
    if call.endswith("/events"):
        path = path.replace("none", "no-such-task")
    with http.stream(method, path, content=content, headers={**headers, "Content-Type": media}) as answer:
        return answer.status_code  # the feed's events never end


def socket_status(http: httpx2.Client, headers: dict[str, str]) -> int:
    url = f"{str(http.base_url).replace('http', 'ws').rstrip('/')}/v1/stream"
    with suppress(websockets.exceptions.WebSocketException), connect(url, additional_headers=headers) as socket:
        if not {"Authorization", "Cookie"} & headers.keys():
            socket.send('{"key": "pw_wrong"}')
        socket.recv(timeout=5.0)
        return 200
    return 401


@pytest.mark.parametrize("role", ROLES)
def test_each_role_may_do_what_the_table_says_and_nothing_else(
    http: httpx2.Client, guarded: Guarded, role: Role | None
) -> None:
    wrong = {}
    for call, row in TABLE.items():
        status = asked(http, call, guarded.headers(role))
        if row.role is None or (row.is_free_here and role is None) or (role is not None and role.permits(row.role)):
            is_right = status not in (401, 403) or (status == 401 and call == "POST /v1/session")
        else:
            is_right = status == (401 if role is None else 403)
        if not is_right:
            wrong[call] = status
    assert wrong == {}
    assert not guarded.server.service.tasks.all(), "no refused or broken call starts anything"


@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": "Bearer pw_wrong"},
        {"Authorization": "Bearer"},
        {"Authorization": "Basic YTpi"},
        {"Authorization": "pw_wrong"},
        {"Cookie": "{cookie}=guessed"},
    ],
)
def test_a_wrong_key_opens_nothing(http: httpx2.Client, guarded: Guarded, headers: dict[str, str]) -> None:
    cookie = f"panelwright_{guarded.server.port}"
    sent = {name: value.format(cookie=cookie) for name, value in headers.items()}
    closed = [call for call, row in TABLE.items() if row.role is not None and not row.is_free_here]
    statuses = {asked(http, call, sent) for call in closed if not call.startswith("WS")}
    assert statuses == {401}
    answer = http.get("/v1/tasks", headers=sent)
    assert answer.headers["www-authenticate"].startswith("Bearer") and "pw_wrong" not in answer.text


def test_a_key_in_the_address_or_in_another_cookie_is_none(http: httpx2.Client, guarded: Guarded) -> None:
    key = guarded.keys[Role.MAINTAINER]
    assert http.get(f"/v1/tasks?key={key}").status_code == 401
    assert http.get("/v1/tasks", headers={"Cookie": f"panelwright_{guarded.server.port}={key}"}).status_code == 401


def test_a_revoked_key_ends_at_once(http: httpx2.Client, guarded: Guarded) -> None:
    book, commit = guarded.server.service.keys, guarded.server.service.commit
    key = {"Authorization": f"Bearer {book.add('guest', Role.OBSERVER, valid_s=None, commit=commit)}"}
    assert http.get("/v1/tasks", headers=key).status_code == 200
    book.revoke("guest", commit=commit)
    assert http.get("/v1/tasks", headers=key).status_code == 401


def test_the_stop_needs_no_key_on_this_machine_and_its_reset_tells_whose_key(
    http: httpx2.Client, guarded: Guarded
) -> None:
    assert http.post("/v1/stop").json()["is_latched"]
    count = http.post("/v1/stop", headers=guarded.headers(Role.OBSERVER)).json()["count"]
    assert guarded.rows("stop")[-1]["key_name"] == "the-observer"
    assert http.post("/v1/stop/reset", json={"seen_count": count}).status_code == 401
    done = http.post("/v1/stop/reset", json={"seen_count": count}, headers=guarded.headers(Role.OPERATOR))
    assert done.status_code == 200
    assert guarded.rows("stop-reset")[-1]["key_name"] == "the-operator"


def test_the_journal_and_the_task_tell_whose_key_asked(http: httpx2.Client, guarded: Guarded) -> None:
    answer = http.post("/v1/judge?wait_s=10", json={"mission": "none"}, headers=guarded.headers(Role.OPERATOR))
    assert answer.status_code >= 400  # there is no such mission; the task was recorded before
    assert guarded.rows("task-queued")[-1]["key_name"] == "the-operator"
    grant = http.post("/v1/lease", json={"holder": "x"}, headers=guarded.headers(Role.OPERATOR)).json()
    token = {"Lease-Token": grant["token"], **guarded.headers(Role.OPERATOR)}
    assert http.post("/v1/lease/release", headers=token).status_code == 200
    assert guarded.rows("lease-acquired")[-1]["key_name"] == "the-operator"
    guarded.server.service.tasks._tasks.clear()


def log_in(http: httpx2.Client, key: str) -> str:
    answer = http.post("/v1/session", json={"key": key})
    assert answer.status_code == 200
    header = answer.headers["set-cookie"]
    assert "httponly" in header.lower() and "samesite=strict" in header.lower() and key not in header
    http.cookies.clear()
    return header.partition(";")[0]


def test_a_browser_logs_in_for_a_cookie_that_only_its_own_page_may_use(http: httpx2.Client, guarded: Guarded) -> None:
    cookie = {"Cookie": log_in(http, guarded.keys[Role.OPERATOR])}
    own = {**cookie, "Origin": guarded.server.url}
    assert http.get("/v1/session", headers=cookie).json() == {
        "access": "keys",
        "name": "the-operator",
        "role": "operator",
    }
    assert http.get("/v1/tasks", headers=cookie).status_code == 200
    assert http.post("/v1/lease", json={"holder": "x"}, headers=cookie).status_code == 401, "no origin"
    strange = {**cookie, "Origin": "http://127.0.0.1:1"}
    assert http.post("/v1/lease", json={"holder": "x"}, headers=strange).status_code == 403
    token = http.post("/v1/lease", json={"holder": "x"}, headers=own).json()["token"]
    assert http.post("/v1/lease/release", headers={**own, "Lease-Token": token}).status_code == 200
    assert http.put("/v1/devices/arm", json={"driver": "fake:arm"}, headers=own).status_code == 403
    assert http.delete("/v1/session", headers=own).status_code == 200
    assert http.get("/v1/tasks", headers=cookie).status_code == 401


def test_a_change_of_an_alarm_names_the_key_whatever_the_request_says(http: httpx2.Client, guarded: Guarded) -> None:
    alarm, headers = "pump_lamp.state", guarded.headers(Role.OPERATOR)
    guarded.server.service.plant.alarms.take([reading(0, None, object="pump_lamp", kind="lamp", state="off", unit="")])
    answer = http.post(f"/v1/alarms/{alarm}/acknowledge", json={"by": "somebody else"}, headers=headers)
    assert (answer.json()["by"], answer.json()["key_name"]) == ("somebody else", "the-operator")
    assert guarded.rows("alarm")[-1]["key_name"] == "the-operator"
    guarded.server.service.plant.alarms.take([reading(1, None, object="pump_lamp", kind="lamp", state="on", unit="")])
    (shown,) = (a for a in http.get("/v1/alarms?all=true", headers=headers).json()["alarms"] if a["id"] == alarm)
    assert (shown["by"], shown["key_name"]) == ("the cell", None)


@pytest.mark.parametrize("site", [None, "same-origin", "none", "same-site", "cross-site"])
def test_a_session_works_for_its_own_page_and_for_no_other(
    http: httpx2.Client, guarded: Guarded, site: str | None
) -> None:
    """The browser table: where a request comes from, by what it asks. Only the page itself may write."""
    cookie = log_in(http, guarded.keys[Role.OPERATOR])
    port = guarded.server.port
    origins = [None, "null", f"http://127.0.0.1:{port}", f"http://localhost:{port}", f"https://127.0.0.1:{port}"]
    origins += ["http://127.0.0.1:1", f"http://127.0.0.1.evil.example:{port}", "https://evil.example", ""]
    for origin in origins:
        headers = {"Cookie": cookie}
        headers |= {} if origin is None else {"Origin": origin}
        headers |= {} if site is None else {"Sec-Fetch-Site": site}
        is_own = origin in origins[2:4] and site in (None, "none", "same-origin")
        for call in (
            "POST /v1/lease/heartbeat",
            "POST /v1/missions",
            "DELETE /v1/images/{image_id}",
            "POST /v1/images",
        ):
            status = asked(http, call, headers)
            assert (status not in (401, 403)) == is_own, (call, headers, status)
        assert (socket_status(http, headers) == 200) == is_own, headers


def test_a_wrong_key_does_not_log_in(http: httpx2.Client) -> None:
    answer = http.post("/v1/session", json={"key": "pw_wrong"})
    assert answer.status_code == 401 and "set-cookie" not in answer.headers


def test_a_stream_takes_the_key_in_the_header_or_as_its_first_message(guarded: Guarded) -> None:
    url = f"{guarded.server.url.replace('http', 'ws')}/v1/stream"
    with connect(url, additional_headers=guarded.headers(Role.OBSERVER)) as socket:
        assert "position_rad" in str(socket.recv(timeout=5.0))
    with connect(url) as socket:
        socket.send(f'{{"key": "{guarded.keys[Role.OBSERVER]}"}}')
        assert "position_rad" in str(socket.recv(timeout=5.0))
    for said in ('{"key": "pw_wrong"}', '{"key": 5}', "[]", "no json"):
        with connect(url) as socket:
            socket.send(said)
            with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
                socket.recv(timeout=5.0)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008


def test_a_stream_ends_with_the_key_that_began_it(
    http: httpx2.Client, guarded: Guarded, monkeypatch: pytest.MonkeyPatch
) -> None:
    book, commit = guarded.server.service.keys, guarded.server.service.commit
    monkeypatch.setattr("service.http.feed_desk.ALIVE_S", 0.05)
    secret = book.add("guest", Role.OBSERVER, valid_s=None, commit=commit)
    url, mine = f"{guarded.server.url.replace('http', 'ws')}/v1/stream", {"Authorization": f"Bearer {secret}"}
    with (
        connect(url, additional_headers=mine) as by_header,
        connect(url) as by_message,
        http.stream("GET", "/v1/feed/events", headers=mine) as feed,
    ):
        by_message.send(f'{{"key": "{secret}"}}')
        lines = feed.iter_lines()
        assert next(lines).startswith("id: ")
        for socket in (by_header, by_message):
            assert "position_rad" in str(socket.recv(timeout=5.0))
        book.revoke("guest", commit=commit)
        for socket in (by_header, by_message):
            with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
                while True:
                    socket.recv(timeout=5.0)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
        assert not [line for line in lines if line.startswith("id: ")], "and this stream ends"


def test_the_events_of_a_task_end_with_the_key_that_follows_it(http: httpx2.Client, guarded: Guarded) -> None:
    book, commit = guarded.server.service.keys, guarded.server.service.commit
    secret = book.add("guest", Role.OBSERVER, valid_s=None, commit=commit)
    ends = threading.Event()
    task = guarded.server.service.tasks.start("wait", {}, lambda _task: ends.wait(60.0), moves=False)
    with http.stream("GET", f"/v1/tasks/{task.id}/events", headers={"Authorization": f"Bearer {secret}"}) as events:
        lines = events.iter_lines()
        assert any("running" in line for line in lines)
        book.revoke("guest", commit=commit)
        ends.set()
        assert not [line for line in lines if "succeeded" in line]


def test_without_keys_everybody_here_may_and_the_page_says_so(client: httpx2.Client) -> None:
    assert client.get("/v1/session").json() == {"access": "open", "name": None, "role": "maintainer"}
    assert client.get("/v1/info").json()["access"] == "open"


def test_a_program_uses_its_own_key_for_its_own_service(guarded: Guarded) -> None:
    assert guarded.server.client().get("/v1/info")["access"] == "keys"
