"""Tests of who uses the console: each person asks in their own session, and nobody in that of another."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx2
import pytest

from service.access.keys import Role
from service.console import mirror as mirror_module
from service.console.alarms_page import alarm_table
from service.console.mirror import Mirror, Person
from service.console.page_frame import trouble
from service.console.people import People
from service.console.service_client import ServiceClient

NAMES = {"panelwright_1=a": ("alice", "operator"), "panelwright_1=b": ("bob", "observer")}


class Service:
    """Answers as a service with keys does, and sets a cookie with each answer, as a log-in does."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str | None, str | None]] = []
        self.is_open = False

    def answer(self, request: httpx2.Request) -> httpx2.Response:
        cookie = request.headers.get("cookie")
        self.asked.append((request.url.path, cookie, request.headers.get("origin")))
        name, role = NAMES.get(cookie or "", (None, None))
        told: dict[str, Any] = {"access": "keys", "name": name, "role": role}
        if self.is_open:
            told = {"access": "open", "name": None, "role": "maintainer"}
        if role is None and not self.is_open and request.url.path != "/v1/session":
            return httpx2.Response(401, json={"status": 401, "detail": "this service needs a key", "hint": "log in"})
        return httpx2.Response(200, json=told, headers={"set-cookie": "panelwright_1=stolen; Path=/"})


@contextmanager
def people(service: Service) -> Iterator[People]:
    client = ServiceClient("http://127.0.0.1:1", transport=httpx2.MockTransport(service.answer))
    yield People(client, cookie="panelwright_1")


def test_each_person_asks_in_their_own_session_and_a_cookie_of_an_answer_is_not_kept() -> None:
    async def scenario(service: Service) -> None:
        with people(service) as crowd:
            alice = await crowd.enter({"panelwright_1": "a", "other": "x"})
            bob = await crowd.enter({"panelwright_1": "b"})
            assert await crowd.enter({}) is None
            assert await crowd.enter({"panelwright_1": "expired"}) is None
            assert alice is not None
            assert bob is not None
            assert alice is not bob
            assert (alice.person, bob.person.name) == (Person(name="alice", role=Role.OPERATOR), "bob")
            assert await crowd.enter({"panelwright_1": "a"}) is alice
            service.asked.clear()
            await bob.client.post("/v1/alarms/x/acknowledge", {})
            assert service.asked == [("/v1/alarms/x/acknowledge", "panelwright_1=b", "http://127.0.0.1:1")]
            await crowd.close()

    asyncio.run(scenario(Service()))


def test_everybody_shares_one_mirror_while_the_service_has_no_keys() -> None:
    async def scenario(service: Service) -> None:
        service.is_open = True
        with people(service) as crowd:
            first, second = await crowd.enter({}), await crowd.enter({"panelwright_1": "old"})
            assert first is second is not None
            assert first.may(Role.MAINTAINER)
            await crowd.close()

    asyncio.run(scenario(Service()))


def test_a_session_that_has_ended_shows_nothing_any_more_and_asks_to_log_in() -> None:
    async def scenario(service: Service) -> None:
        client = ServiceClient("http://127.0.0.1:1", transport=httpx2.MockTransport(service.answer))
        mirror = Mirror(client.in_session("panelwright_1=a"))
        await mirror._ask("info")
        assert mirror.said("info") is not None
        mirror.client = client.in_session("panelwright_1=revoked")
        await mirror._ask("ready")
        assert mirror.said("info") is None
        assert 'href="/login.html"' in trouble(mirror)
        await client.close()

    asyncio.run(scenario(Service()))


def test_the_mirror_of_a_person_who_has_left_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario(service: Service) -> None:
        with people(service) as crowd:
            alice = await crowd.enter({"panelwright_1": "a"})
            monkeypatch.setattr(mirror_module, "LEFT_S", -1.0)
            await crowd.enter({"panelwright_1": "b"})
            monkeypatch.undo()
            assert await crowd.enter({"panelwright_1": "a"}) is not alice
            await crowd.close()

    asyncio.run(scenario(Service()))


@pytest.mark.parametrize(
    ("role", "deeds"),
    [
        (Role.OBSERVER, []),
        (Role.OPERATOR, ["acknowledge", "comment", "shelve"]),
        (Role.MAINTAINER, ["acknowledge", "comment", "shelve", "out-of-service"]),
    ],
)
def test_a_page_offers_only_what_the_role_may_do(role: Role, deeds: list[str]) -> None:
    mirror = Mirror(ServiceClient("http://127.0.0.1:1"), person=Person(name="x", role=role))
    alarm = {
        "id": "pressure.high", "object": "pressure", "kind": "high", "state": "unacknowledged", "priority": "high",
        "is_active": True, "shelved_until_s": None, "says": "too high", "what_to_do": "", "reason": "", "by": "",
        "raised_s": 1e9,
    }  # fmt: skip
    mirror._said = {"alarms": {"alarms": [alarm]}}
    told = alarm_table(mirror)
    assert [
        deed for deed in ("acknowledge", "comment", "shelve", "out-of-service") if f'data-deed="{deed} ' in told
    ] == deeds
