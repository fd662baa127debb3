"""The page of the HTTP API in a real browser: it shows every call, and loads nothing from another host."""

from __future__ import annotations

from typing import Any

from service.serve import Panelwright
from tests.service.browser import NEEDS_CHROMIUM, browser, new_tab, until

__all__ = ["browser"]  # a fixture
pytestmark = NEEDS_CHROMIUM


def test_the_page_shows_every_call_and_loads_nothing_from_elsewhere(
    browser: Any, served: Panelwright, client: Any
) -> None:
    tab, faults = new_tab(browser, height_px=900)
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(f"{served.url}/docs")
    until(tab, "document.querySelectorAll('details').length > 20")
    paths = client.get("/openapi.json").json()["paths"]
    wanted = {f"{method} {path}" for path, item in paths.items() for method in item}
    shown = tab.evaluate("() => [...document.querySelectorAll('details')].map((one) => one.dataset.words)")
    assert {" ".join(words.split()[:2]) for words in shown} == {call.lower() for call in wanted}
    tab.fill("#search", "put limits")
    until(tab, "[...document.querySelectorAll('details')].filter((one) => !one.hidden).length === 1")
    tab.click("#set_limits summary")
    until(tab, "document.querySelector('#set_limits').textContent.includes('deadband')")
    assert "an alarm ends when the value is inside" in tab.inner_text("#set_limits")
    assert [url for url in asked if not url.startswith(served.url)] == []
    assert faults == []
