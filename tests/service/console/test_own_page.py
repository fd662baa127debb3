"""Tests of who may reach the console, and of how it knows its service."""

from __future__ import annotations

import asyncio
import socket
import ssl
import threading
from pathlib import Path

import httpx2
import pytest
from fastapi import FastAPI

from service.client import trusting_only
from service.console.own_page import Reach, is_own, is_peer
from service.console.people import People
from service.console.relay import MOST_BYTES, install_relay
from service.console.service_client import ServiceClient
from tests.service.test_exposure import certificate


def shakes_hands(server: tuple[Path, Path], trusted: Path) -> bool:
    """Return whether somebody who trusts one certificate accepts a server with another."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*server)
    here, there = socket.socketpair()

    def answer() -> None:
        with there:
            try:
                context.wrap_socket(there, server_side=True).close()
            except OSError:
                return

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        trusting_only(trusted).wrap_socket(here, server_hostname="127.0.0.1").close()
    except ssl.SSLCertVerificationError:
        return False
    finally:
        here.close()
        thread.join()
    return True


def test_the_certificate_of_the_service_is_trusted_whatever_its_name_and_no_other_is(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "other").mkdir()
    own = certificate(tmp_path / "own", name="cell-3.plant.example")
    assert shakes_hands(own, own[0])
    assert not shakes_hands(certificate(tmp_path / "other"), own[0])


@pytest.mark.parametrize(
    ("headers", "is_allowed"),
    [
        ({"host": "cell-3.plant.example"}, True),
        ({"host": "cell-3.plant.example", "origin": "https://cell-3.plant.example"}, True),
        ({"host": "cell-3.plant.example:8443", "origin": "https://cell-3.plant.example:8443"}, True),
        ({"host": "cell-3.plant.example", "origin": "https://cell-3.plant.example:8443"}, False),
        ({"host": "cell-4.plant.example", "origin": "https://cell-4.plant.example"}, False),
        ({"host": "cell-3.plant.example", "origin": "https://evil.example"}, False),
    ],
)
def test_the_names_of_the_service_are_those_of_the_console(headers: dict[str, str], is_allowed: bool) -> None:
    reach = Reach(names=frozenset({"cell-3.plant.example"}), schemes=frozenset({"http", "https"}), is_local=False)
    assert is_own(headers, reach) is is_allowed
    assert not is_own(headers), "a console that only this machine reaches has no further name"


def test_only_the_proxy_and_this_machine_connect_behind_a_proxy() -> None:
    reach = Reach(peers=frozenset({"10.0.0.2"}), is_local=False)
    assert [is_peer(one, reach) for one in ("10.0.0.2", "127.0.0.1", "10.0.0.3")] == [True, True, False]
    assert is_peer("10.0.0.3", Reach(is_local=False)), "with TLS of its own, whoever has the name may"


def test_the_console_passes_on_what_the_form_for_teaching_asks_and_no_other_call() -> None:
    asked: list[tuple[str, str, bytes, str | None]] = []

    def service(request: httpx2.Request) -> httpx2.Response:
        media = request.headers.get("content-type")
        asked.append((request.method, str(request.url.copy_with(host="service")), request.content, media))
        return httpx2.Response(422, json={"detail": "no such image", "hint": "upload it"})

    async def story() -> list[int]:
        people = People(ServiceClient("http://service", transport=httpx2.MockTransport(service)), cookie="session")
        app = FastAPI()
        install_relay(app, people)
        transport = httpx2.ASGITransport(app=app)
        async with httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1") as browser:
            found = await browser.post("/v1/images?a=1", content=b"png", headers={"Content-Type": "image/png"})
            assert (found.status_code, found.json()["hint"]) == (422, "upload it"), "a problem comes as it is"
            refused = [
                await browser.post("/v1/missions", json={}),
                await browser.post("/v1/knowledge/../lease", json={}),
                await browser.delete("/v1/knowledge/kinds/a/b"),
                await browser.get("/v1/alarms"),
            ]
            huge = await browser.post("/v1/images", content=b"x" * (MOST_BYTES + 1))
            return [one.status_code for one in (*refused, huge)]

    assert asyncio.run(story()) == [404, 404, 404, 404, 413]
    assert asked == [("POST", "http://service/v1/images?a=1", b"png", "image/png")]
