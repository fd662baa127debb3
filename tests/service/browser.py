"""Real browser for the tests of the web pages, which are skipped if there is no Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.waiting import eventually

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
CONSOLE_PAGES = (
    "/",
    "/missions",
    "/rounds",
    "/alarms",
    "/review",
    "/history",
    "/devices",
    "/setup",
    "/cell",
    "/mission-editor",
    "/teach",
)
OWN_PAGES = {
    "/": "#devices li",
    "/docs": "details",
    "/teach.html": "#known",
    "/login.html": "#key",
}  # with a part of each
PATIENCE_MS = 150_000  # the first click may compile kernels, and the machine may be busy
NEEDS_CHROMIUM = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no Chromium: apt-get install chromium"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


def barriers(tab: Any) -> list[str]:
    """Return what axe finds on a page that keeps somebody from using it, each with its first element.

    It waits until nothing fades in any more, because half faded text has little contrast.
    """
    from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]  # it has no annotations

    until(tab, "document.getAnimations().length === 0")
    faults = Axe().run(tab).response["violations"]
    return [f"{fault['id']}: {fault['nodes'][0]['html'][:120]}" for fault in faults]


def new_tab(browser: Any, *, height_px: int) -> tuple[Any, list[str]]:
    """Return a tab, and the list of script errors and violations of the page's content policy."""
    tab = browser.new_page(viewport={"width": 1400, "height": height_px})
    tab.set_default_timeout(PATIENCE_MS)
    faults: list[str] = []
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.on("console", lambda line: faults.append(line.text) if "Content Security" in line.text else None)
    return tab, faults


def until(page: Any, claim: str) -> None:
    """Wait until a JavaScript condition holds; evaluated from outside, because the page's policy forbids `eval`."""
    eventually(lambda: page.evaluate(f"() => Boolean({claim})"))
