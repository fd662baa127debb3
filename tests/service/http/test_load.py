"""Silent, slow and greedy clients shut nobody out: stop and health are always answered."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import httpx2
import pytest
from fastapi import FastAPI

from hal.errors import CellError
from hal.priorities import Priority, take_priority
from service.errors import Busy
from service.http.guard import Allowed, RequestGuard
from service.http.load import LimitedProtocol, Load
from service.serve import Panelwright
from tests.service.verbs import HoldRequest
from tests.service.waiting import eventually

UPLOAD = b"POST /v1/images HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: image/png\r\nContent-Length: 900000\r\n\r\n"
STOP = b"POST /v1/stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n"


@contextmanager
def connected(served: Panelwright) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", served.port), timeout=60.0) as link:
        yield link


def test_405_silent_connections_shut_nobody_out(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.load.HEAD_S", 300.0)  # so that only their number closes them
    with ExitStack() as crowd:
        links = [crowd.enter_context(connected(served)) for _ in range(405)]
        with httpx2.Client(base_url=served.url, timeout=30.0, trust_env=False) as fresh:
            assert fresh.get("/healthz").status_code == 200
            assert fresh.post("/v1/stop").json()["is_latched"]
        assert links[0].recv(1) == b"", "the connection that was silent for the longest time is closed"


def test_a_head_that_never_comes_ends_its_connection(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.load.HEAD_S", 0.05)
    with connected(served) as silent, connected(served) as slow:
        slow.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127")
        assert (silent.recv(1), slow.recv(1)) == (b"", b"")
    with connected(served) as second:  # also after an answer on the same connection
        second.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        answer = b""
        while not answer.endswith(b"}"):
            part = second.recv(4000)
            assert part, answer
            answer += part
        assert b"200 OK" in answer
        second.sendall(b"GET /heal")
        assert second.recv(4000) == b""


def test_a_body_that_never_comes_is_a_problem(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.load.BODY_S", 0.05)
    with connected(served) as link:
        link.sendall(UPLOAD + b"x")
        answer = b"".join(iter(lambda: link.recv(4000), b""))
    assert b"408" in answer.partition(b"\r\n")[0] and b"body-timeout" in answer
    with connected(served) as link:
        link.sendall(STOP)
        assert b"200 OK" in link.recv(4000).partition(b"\r\n")[0], "a stop does not wait for a body"


def test_uploads_that_never_end_do_not_fill_the_memory(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.guard.MAX_BODY_BYTES_OVERALL", 1_000_000)
    with ExitStack() as uploads:
        links = [uploads.enter_context(connected(served)) for _ in range(3)]
        for link in links:
            link.sendall(UPLOAD + bytes(450_000))
        refused = eventually(lambda: next((link for link in links if _has_answer(link)), None))
        assert b"503" in refused.recv(4000).partition(b"\r\n")[0]
        assert client.post("/v1/stop").json()["is_latched"]
    eventually(lambda: client.post("/v1/echo?wait_s=5", json={"text": "x" * 90}).status_code == 200)


def _has_answer(link: socket.socket) -> bool:
    link.settimeout(0.2)
    try:
        return bool(link.recv(1, socket.MSG_PEEK))
    except TimeoutError:
        return False


def test_one_client_cannot_fill_the_queue_of_all(served: Panelwright, client: httpx2.Client) -> None:
    def ask(name: str) -> str:
        return served.service.submit("hold", HoldRequest(), client=name).id

    started = [ask("10.0.0.1")]
    eventually(lambda: served.service.tasks.get(started[0]).state == "running")
    started += [ask("10.0.0.1") for _ in range(8)]
    with pytest.raises(Busy, match=r"8 tasks of 10\.0\.0\.1"):
        ask("10.0.0.1")
    started += [ask("10.0.0.2") for _ in range(8)]
    with pytest.raises(CellError, match="16 tasks wait"):
        ask("10.0.0.3")
    served.service.tasks.cancel_moving("test")
    for task in started:
        eventually(lambda task=task: served.service.tasks.get(task).state.is_final)


def test_too_many_requests_of_one_client_are_refused_but_stop_and_health_are_not(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.load.MAX_REQUESTS_OF_CLIENT", 0)
    refused = client.get("/v1/tasks")
    assert (refused.status_code, refused.json()["type"]) == (503, "urn:panelwright:busy")
    assert refused.headers["Retry-After"] == "1"
    assert client.get("/healthz").status_code == 200
    assert client.get("/readyz").status_code == 200
    assert client.post("/v1/stop").status_code == 200


def test_requests_in_work_are_counted_by_client_and_overall(monkeypatch: pytest.MonkeyPatch) -> None:
    load = Load()
    monkeypatch.setattr("service.http.load.MAX_REQUESTS_OF_CLIENT", 2)
    monkeypatch.setattr("service.http.load.MAX_REQUESTS", 3)
    with load.request("a"), load.request("a"):
        assert "of your machine" in str(load.refusal("/v1/tasks", "a"))
        assert load.refusal("/v1/tasks", "b") is None
        with load.request("b"):
            assert "3 requests are in work" in str(load.refusal("/v1/tasks", "c"))
            assert load.refusal("/v1/stop", "a") is None
    assert load.refusal("/v1/tasks", "a") is None


def test_of_too_many_connections_those_of_the_greediest_client_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.http.load.MAX_CONNECTIONS", 4)
    load, closed = Load(), list[str]()

    class Connection:
        def __init__(self, name: str) -> None:
            self.name, self.host = name, name[0]

        def give_up(self) -> None:
            load.closed(self)  # type: ignore[arg-type]
            closed.append(self.name)

    for name in ("b1", "a1", "a2", "a3", "a4", "b2"):
        load.opened(Connection(name))  # type: ignore[arg-type]
    assert closed == ["a1", "a2"]
    one, other = Load(), Connection("c1")
    one.opened(other)  # type: ignore[arg-type]
    one.works(other)  # type: ignore[arg-type]
    load = one
    for name in ("c2", "c3", "b1", "b2"):
        load.opened(Connection(name))  # type: ignore[arg-type]
    assert closed == ["a1", "a2", "c2"], "one that is in work is left alone"


def test_what_computes_waits_for_its_modules_and_nothing_else_does(served: Panelwright, client: httpx2.Client) -> None:
    served.is_loaded.clear()
    with ThreadPoolExecutor(1) as pool:
        try:
            waiting = pool.submit(client.get, "/v1/knowledge")
            for path in ("/healthz", "/readyz", "/v1/info", "/v1/tasks", "/v1/devices", "/v1/stop", "/v1/lease"):
                assert client.get(path).status_code == 200, path
            assert client.post("/v1/stop").json()["is_latched"]
            assert not waiting.done()
        finally:
            served.is_loaded.set()
        assert waiting.result(30.0).status_code == 200


def test_what_waits_for_its_modules_is_refused_when_the_service_ends() -> None:
    counted: list[int] = []
    allowed = Allowed(hosts=frozenset({"127.0.0.1"}), origins=frozenset())
    guard = RequestGuard(FastAPI(), allowed=allowed, count=counted.append, is_loaded=lambda: False)

    async def asked_before_the_end() -> httpx2.Response:
        transport = httpx2.ASGITransport(app=guard)
        async with httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            waiting = asyncio.create_task(client.get("/v1/knowledge"))
            await asyncio.sleep(0)
            guard.load.end()
            return await waiting

    answer = asyncio.run(asked_before_the_end())
    assert (answer.status_code, answer.json()["title"], counted) == (503, "Ending", [503])


@pytest.mark.usefixtures("served")
def test_the_event_loop_and_the_watch_of_the_lease_are_real_time_where_that_is_allowed() -> None:
    with ThreadPoolExecutor(1) as other:
        wanted = other.submit(lambda: take_priority(Priority.ANSWERS) or os.sched_getscheduler(0)).result()
    prompt = [thread.native_id for thread in threading.enumerate() if thread.name in ("http", "_watch_lease")]
    assert len(prompt) >= 2
    eventually(lambda: {os.sched_getscheduler(one) for one in prompt if one} == {wanted})  # unless the loop is busy


def test_threads_that_compute_are_nicer_than_the_process(client: httpx2.Client) -> None:
    client.get("/v1/devices/wrist_camera/reading")
    client.post("/v1/echo?wait_s=10", json={"text": "a"})
    nicer = min(19, os.getpriority(os.PRIO_PROCESS, os.getpid()) + 10)
    for name in ("device-read", "task-"):
        threads = [thread.native_id for thread in threading.enumerate() if thread.name.startswith(name)]
        assert threads, name
        assert {os.getpriority(os.PRIO_PROCESS, thread) for thread in threads if thread} == {nicer}


def test_a_chunk_is_pushed_only_while_the_connection_has_room() -> None:
    chunk = bytes(range(256)) * 256

    async def story() -> None:
        near, far = socket.socketpair()
        with far:
            loop = asyncio.get_running_loop()
            protocol = LimitedProtocol.__new__(LimitedProtocol)
            protocol.transport, _ = await loop.create_connection(asyncio.Protocol, sock=near)
            pushed = 0
            while protocol.push(chunk):
                pushed += 1
            assert not protocol.push(chunk), "a full connection was given more"
            reading = asyncio.to_thread(far.recv, pushed * len(chunk), socket.MSG_WAITALL)
            assert await reading == pushed * chunk
            assert protocol.push(chunk)
            protocol.transport.close()
            assert not protocol.push(chunk)

    asyncio.run(story())


def test_a_body_that_has_not_arrived_is_given_up_at_once_when_the_server_ends() -> None:
    async def wait() -> None:
        load = Load()
        async with load.body_time(3600.0):
            load.end()
            await asyncio.wait([asyncio.ensure_future(asyncio.Event().wait())], timeout=10.0)

    with pytest.raises(TimeoutError):
        asyncio.run(wait())
