"""Every write asks the same gate over HTTP, and a motion ends with the client that asked for it."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from typing import Any

import httpx2
import pytest

from service.http.permissions import TABLE, Asks
from service.serve import Panelwright
from tests.service.http.test_access import asked
from tests.service.waiting import eventually


@pytest.fixture
def token(client: httpx2.Client, served: Panelwright) -> Iterator[str]:
    """Yield the token of a lease that lasts for the test."""
    lease = served.service.lease
    ttl_s, lease.ttl_s = lease.ttl_s, 1e6
    yield client.post("/v1/lease", json={"holder": "alice"}).json()["token"]
    lease.ttl_s = ttl_s
    lease.release(lease.take_over("cleaner").token)


@pytest.mark.parametrize("call", [call for call, row in TABLE.items() if row.asks is Asks.LEASE])
def test_while_the_lease_is_held_every_write_of_others_is_refused(client: httpx2.Client, token: str, call: str) -> None:
    assert asked(client, call, {}) == 409
    assert asked(client, call, {"Lease-Token": "1.guessed"}) == 409
    assert asked(client, call, {"Lease-Token": token}) != 409


def test_a_task_that_only_writes_asks_too_and_one_that_only_reads_does_not(client: httpx2.Client, token: str) -> None:
    assert client.post("/v1/note", json={}).status_code == 409
    assert client.post("/v1/note?wait_s=10", json={}, headers={"Lease-Token": token}).status_code == 200
    assert client.post("/v1/measure?wait_s=10", json={}).status_code == 200


def test_commands_are_numbered_and_a_repeat_with_its_key_is_the_same_task(client: httpx2.Client, token: str) -> None:
    def hold(number: int, **headers: str) -> httpx2.Response:
        sent = {"Lease-Token": token, "Lease-Sequence": str(number), **headers}
        return client.post("/v1/hold?wait_s=10", json={"seconds": 0.01}, headers=sent)

    first = hold(5, **{"Idempotency-Key": "five"})
    assert first.status_code == 200 and client.get("/v1/lease").json()["sequence"] == 5
    assert hold(5).json()["type"] == "urn:panelwright:stale-sequence"
    assert hold(5, **{"Idempotency-Key": "five"}).json()["id"] == first.json()["id"]
    assert hold(6).status_code == 200
    for bad in ("-1", "x", "1e3", str(2**63)):
        assert client.post("/v1/hold", json={}, headers={"Lease-Sequence": bad}).status_code == 422


def test_a_command_comes_in_time_or_is_refused(client: httpx2.Client) -> None:
    def hold(after_s: float) -> httpx2.Response:
        until_s = client.get("/v1/lease").json()["clock_s"] + after_s
        return client.post("/v1/hold?wait_s=10", json={"seconds": 0.01}, headers={"Command-Until": str(until_s)})

    assert hold(9.0).status_code == 200
    assert (hold(-1.0).status_code, hold(-1.0).json()["type"]) == (409, "urn:panelwright:expired")
    assert hold(60.0).json()["type"] == "urn:panelwright:too-distant"
    assert client.post("/v1/hold", json={}, headers={"Command-Until": "nan"}).status_code == 422


def test_a_command_that_waited_too_long_in_the_queue_does_not_begin(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = client.post("/v1/hold", json={}).headers["location"]
    until_s = str(client.get("/v1/lease").json()["clock_s"] + 5.0)
    waiting = client.post("/v1/hold", json={}, headers={"Command-Until": until_s}).headers["location"]
    real = served.service.lease.clock_s()
    monkeypatch.setattr(served.service.lease._clock, "now_s", lambda: real + 6.0, raising=False)
    client.post(f"{before}/cancel?wait_s=10")
    task = client.get(f"{waiting}?wait_s=10").json()
    assert (task["state"], task["problem"]["type"]) == ("failed", "urn:panelwright:expired")


def test_a_take_over_has_a_reason_which_is_recorded(client: httpx2.Client, served: Panelwright) -> None:
    assert client.post("/v1/lease/take-over", json={"holder": "bob"}).status_code == 422
    assert client.post("/v1/lease/take-over", json={"holder": "bob", "reason": ""}).status_code == 422
    said = {"holder": "bob", "reason": "alice has gone home"}
    token = client.post("/v1/lease/take-over", json=said).json()["token"]
    told = served.service.journal.records(kinds=("lease-taken-over",))[-1].data
    assert (told["holder"], told["reason"]) == ("bob", "alice has gone home")
    client.post("/v1/lease/release", headers={"Lease-Token": token})


def start_and_keep_open(served: Panelwright, wait_s: float, headers: str = "") -> socket.socket:
    """Ask for a motion without an end and return the connection, on which the answer is awaited."""
    body = json.dumps({})
    connection = socket.create_connection(("127.0.0.1", served.port))
    connection.sendall(
        f"POST /v1/hold?wait_s={wait_s:g} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n{headers}"
        f"Content-Length: {len(body)}\r\n\r\n{body}".encode()
    )
    return connection


def moving(served: Panelwright) -> Any:
    return eventually(served.service.tasks.moving)


def test_a_motion_without_a_lease_ends_with_the_connection_of_its_client(
    client: httpx2.Client, served: Panelwright
) -> None:
    del client
    with start_and_keep_open(served, 30.0):
        task = moving(served)
    assert task.wait(20.0) and task.state == "cancelled"
    assert "client is gone" in task.problem["detail"]


def test_a_motion_under_a_lease_does_not(client: httpx2.Client, served: Panelwright, token: str) -> None:
    with start_and_keep_open(served, 30.0, f"Lease-Token: {token}\r\n"):
        task = moving(served)
    before = client.get("/v1/lease").json()["epoch"]
    assert task.sub_lease is not None and task.sub_lease.name.startswith(f"{before}.")
    assert not task.wait(0.3), "the heartbeat of the lease decides"
    served.service.tasks.cancel(task.id)
    assert task.wait(20.0)


def test_a_motion_without_a_lease_goes_on_while_somebody_follows_it(client: httpx2.Client, served: Panelwright) -> None:
    subs = served.service.lease.subs
    window_s, subs.window_s = subs.window_s, 0.2
    try:
        where = client.post("/v1/hold?wait_s=0", json={}).headers["location"]
        with client.stream("GET", f"{where}/events") as events:
            lines = events.iter_lines()
            next(lines)
            task = moving(served)
            assert not task.wait(0.6)
        assert task.wait(20.0), "nobody follows it any more"
        assert task.state == "cancelled" and "nobody followed" in task.problem["detail"]
    finally:
        subs.window_s = window_s
