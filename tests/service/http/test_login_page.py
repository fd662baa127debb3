"""The pages of a service with keys in a real browser: they ask for a key, show whose it is, and log out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hal.config import load_cell
from service.access.keys import Role
from service.serve import Options, Panelwright
from tests.service.browser import NEEDS_CHROMIUM, browser, new_tab, until
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS

__all__ = ["browser"]  # a fixture
pytestmark = NEEDS_CHROMIUM


def test_a_browser_logs_in_works_and_logs_out(browser: Any, write_cell: WriteCell, tmp_path: Path) -> None:
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True)
    server = Panelwright(load_cell(write_cell(robot=True)), options, operations=OPERATIONS)
    secret = server.service.keys.add("alice", Role.OPERATOR, valid_s=None, commit=server.service.commit)
    try:
        server.start()
        tab, faults = new_tab(browser, height_px=1000)
        tab.goto(f"{server.url}/teach.html")
        tab.wait_for_url("**/login.html?next=%2Fteach.html")
        tab.fill("#key", "pw_wrong")
        tab.click("#login button")
        until(tab, "document.querySelector('#login-line').textContent.includes('not valid')")
        tab.fill("#key", secret)
        tab.click("#login button")
        tab.wait_for_url("**/teach.html")
        tab.goto(server.url)
        until(tab, "document.querySelector('#access-line').textContent.includes('alice (operator)')")
        until(tab, "document.querySelectorAll('#devices li').length === 8")
        until(tab, "document.querySelector('#live-state').textContent !== '–'")
        assert tab.evaluate("() => document.cookie") == "", "scripts cannot read the session"
        tab.click("#log-out")
        tab.wait_for_url("**/login.html")
        tab.goto(server.url)
        tab.wait_for_url("**/login.html?next=%2F")
        assert not faults
    finally:
        server.close()
