"""Tests of the console from elsewhere: with TLS of its own, and behind a proxy. Skipped if there is no Chromium."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from service.access.keys import Role
from service.exposure import Exposure
from tests.service.browser import NEEDS_CHROMIUM
from tests.service.conftest import WriteCell, _write
from tests.service.console import nginx
from tests.service.console.nginx import Nginx
from tests.service.console.served import Cell, until
from tests.service.console.tls_proxy import TlsProxy
from tests.service.test_exposure import certificate

pytestmark = NEEDS_CHROMIUM
KEYS = {"bob": Role.OBSERVER, "carol": Role.OPERATOR}


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Cell, str]]:
    """Yield a cell behind a proxy that ends TLS, and the address of its console there.

    The proxy is nginx with the example of the documentation, and a small one of the tests where nginx is not installed.
    """
    folder = tmp_path_factory.mktemp("proxied")
    proxy = (Nginx if nginx.PROGRAM.exists() else TlsProxy)(*certificate(folder))
    exposure = Exposure(names=(f"localhost:{proxy.port}",), behind_proxy=True, unix_socket=folder / "socket")
    cell = Cell(lambda **given: _write(folder, **given), folder / "runs", keys=KEYS, exposure=exposure)
    proxy.start(service=folder / "socket", console_port=cell.console.port)
    yield cell, f"https://localhost:{proxy.port}"
    proxy.close()
    cell.service.close()


def test_people_log_in_and_stop_through_a_proxy_also_while_the_console_hangs(
    browser: Any, proxied: tuple[Cell, str]
) -> None:
    cell, url = proxied
    context = browser.new_context(ignore_https_errors=True)
    tab = context.new_page()
    tab.set_default_timeout(60_000)
    tab.goto(f"{url}/missions")
    tab.wait_for_url("**/login.html?next=%2Fmissions")
    tab.fill("#key", cell.secrets["carol"])
    tab.click("#login button")
    tab.wait_for_url("**/missions")
    until(tab, "document.querySelector('#person').textContent.includes('carol (operator')")
    (cookie,) = [one for one in context.cookies() if one["name"].startswith("panelwright")]
    assert (cookie["secure"], cookie["httpOnly"], cookie["sameSite"]) == (True, True, "Strict")
    tab.click("button:text-is('Run mission'):not([disabled])")
    until(tab, "document.querySelector('.steps').textContent.includes('Holding')")
    os.kill(cell.console.pid, signal.SIGSTOP)
    try:
        tab.click("#stop-button")
        until(tab, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    finally:
        os.kill(cell.console.pid, signal.SIGCONT)
    assert cell.service.service.supervisor.latch.is_set()
    tab.click("#stop-reset:not([hidden])")
    until(tab, "document.querySelector('#stop-box').dataset.latched === 'no'")
    context.close()


def test_the_console_has_the_tls_of_the_service_whatever_name_its_certificate_has(
    browser: Any, write_cell: WriteCell, tmp_path: Path
) -> None:
    cert, key = certificate(tmp_path, name="cell-3.plant.example")
    exposure = Exposure(host="127.0.0.1", names=("cell-3.plant.example",), tls_cert=cert, tls_key=key)
    cell = Cell(write_cell, tmp_path / "runs", keys=KEYS, exposure=exposure)
    context = browser.new_context(ignore_https_errors=True)
    try:
        assert cell.url.startswith("https://127.0.0.1:")
        tab = context.new_page()
        tab.goto(cell.url)
        tab.wait_for_url("**/login.html?next=%2F")
        tab.fill("#key", cell.secrets["bob"])
        tab.click("#login button")
        tab.wait_for_url(lambda address: "login" not in address)
        until(tab, "document.querySelector('#person').textContent.includes('bob (observer')")
        until(tab, "document.querySelector('#stop-box').dataset.latched === 'no'")
        tab.click("#stop-button")
        until(tab, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    finally:
        context.close()
        cell.service.close()


def test_a_stranger_at_the_proxy_cannot_even_stop(proxied: tuple[Cell, str]) -> None:
    cell, _url = proxied
    with httpx2.Client(base_url=f"http://127.0.0.1:{cell.console.port}", trust_env=False) as http:
        assert http.post("/relay/stop").status_code == 401
        assert http.get("/", headers={"Host": "evil.example"}).status_code == 403
    assert not cell.service.service.supervisor.latch.is_set()
