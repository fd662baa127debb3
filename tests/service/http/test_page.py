"""Tests of the web page in a real browser: display, start, stop and reset. Skipped if there is no Chromium."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.config import load_cell
from hal.simulated import Fault
from service.client import Client
from service.operations import Operation
from service.serve import Options, Panelwright
from tests.service.browser import NEEDS_CHROMIUM, OWN_PAGES, barriers, browser, new_tab, until
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS, HoldRequest, HoldResult, hold
from tests.service.waiting import eventually

__all__ = ["browser"]  # a fixture
pytestmark = NEEDS_CHROMIUM


@pytest.fixture(scope="module")
def served_page(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield a cell of fakes whose mission stands still for a long time."""
    missions = Operation(
        name="missions", request_model=HoldRequest, result_model=HoldResult, run=hold, summary="Hold", moves=True
    )
    runs = tmp_path_factory.mktemp("runs")
    (runs / "2026-01-02T03-04-05").mkdir()
    (runs / "2026-01-02T03-04-05" / "report.json").write_text("{}")
    (runs / "2026-01-02T03-04-05" / "report.html").write_text("<h1>all done</h1>")
    panelwright = Panelwright(
        load_cell(write_module_cell(robot=True)),
        Options(port=0, runs_dir=runs, inline=True),
        operations={**OPERATIONS, "missions": missions},
    )
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture(scope="module")
def page(browser: Any, served_page: Panelwright) -> Iterator[Any]:
    tab, faults = new_tab(browser, height_px=1000)
    tab.goto(served_page.url)
    yield tab
    assert not faults


def test_cell_devices_and_picture_show(page: Any) -> None:
    until(page, "document.querySelector('#cell-line').textContent.includes('cell fake')")
    until(page, "document.querySelectorAll('#devices li').length === 8")
    assert page.text_content("#devices-line") == "8 of 8 good"
    until(page, "document.querySelector('#picture').naturalWidth === 64")
    page.click("text=range scanner")
    until(page, "document.querySelector('#picture').naturalWidth === 16")


def test_the_tasks_can_be_read_on_a_telephone(page: Any, served_page: Panelwright) -> None:
    """The cause of a failed task must not be wrapped after each letter."""
    telephone = page.context.browser.new_page(viewport={"width": 400, "height": 800})
    telephone.goto(served_page.url)
    client = Client(url=served_page.url)
    task = client.post("/v1/echo", {"text": "hello"})
    client.get(f"/v1/tasks/{task['id']}?wait_s=30")
    until(telephone, "document.querySelectorAll('#tasks td.step').length")
    assert telephone.evaluate("() => document.querySelector('#tasks td.step').clientWidth") > 100
    assert telephone.evaluate("() => document.documentElement.scrollWidth") <= 400
    telephone.close()


@pytest.mark.parametrize(("width_px", "scheme"), [(1440, "light"), (390, "dark")])
def test_no_page_of_the_service_has_a_barrier(
    browser: Any, served_page: Panelwright, width_px: int, scheme: str
) -> None:
    context = browser.new_context(viewport={"width": width_px, "height": 844}, color_scheme=scheme, bypass_csp=True)
    tab = context.new_page()
    found: list[str] = []
    for path, sign in OWN_PAGES.items():
        tab.goto(served_page.url + path)
        until(tab, f"document.querySelectorAll('{sign}').length")
        found += [f"{path} {fault}" for fault in barriers(tab)]
    context.close()
    assert found == []


def test_the_arm_shows_live(page: Any) -> None:
    until(page, "document.querySelectorAll('#joints .joint').length === 6")
    assert "mm" in page.text_content("#live")


def test_what_a_silent_arm_said_last_is_called_stale(page: Any, served_page: Panelwright) -> None:
    until(page, "document.querySelector('#live-state').textContent === 'at rest'")
    arm = served_page.service.supervisor.connection.device("arm")
    arm.inject_fault(Fault.SILENT)
    until(page, "document.querySelector('#live-state').textContent === 'stale: arm'")
    arm.inject_fault(None)
    until(page, "document.querySelector('#live-state').textContent === 'at rest'")


def test_a_device_that_is_missing_is_connected_from_the_page(
    browser: Any, write_cell: WriteCell, tmp_path: Path
) -> None:
    trouble = tmp_path / "trouble"
    trouble.write_text("away")
    cell = load_cell(write_cell(robot=True, options={"arm": {"trouble": str(trouble)}}))
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True, partial=True)
    panelwright = Panelwright(cell, options, operations=OPERATIONS)
    panelwright.start()
    tab, faults = new_tab(browser, height_px=1000)
    try:
        tab.goto(panelwright.url)
        until(tab, "document.querySelector('#devices').textContent.includes('arm did not connect: is not on its port')")
        until(tab, "document.querySelector('#live').textContent.includes('arm did not connect')")
        assert tab.evaluate("() => document.documentElement.scrollWidth") <= 1400
        tab.click("button:text-is('connect')")
        until(tab, "document.querySelector('#devices').textContent.includes('plug it in')")
        trouble.unlink()
        tab.click("button:text-is('connect'):not([disabled])")
        until(tab, "document.querySelector('#devices-line').textContent === '8 of 8 good'")
        until(tab, "document.querySelector('#live-state').textContent === 'at rest'")
        assert not faults
    finally:
        tab.close()
        panelwright.close()


def test_the_last_report_is_linked(page: Any) -> None:
    page.wait_for_selector("#report:not([hidden])")
    assert page.get_attribute("#report", "href") == "/v1/missions/2026-01-02T03-04-05/report.html"


def test_a_mission_runs_with_progress_and_can_be_cancelled(page: Any) -> None:
    page.click("#start:not([disabled])")
    until(page, "document.querySelector('#mission-state').textContent === 'running'")
    until(page, "document.querySelector('#steps').textContent.includes('holding')")
    assert page.is_disabled("#start")
    page.click("#cancel:not([hidden])")
    until(page, "document.querySelector('#mission-state').textContent === 'cancelled'")
    until(page, "document.querySelector('#tasks').textContent.includes('missions')")


def test_stop_latches_visibly_and_only_a_reset_clears_it(page: Any, served_page: Panelwright) -> None:
    page.click("#start:not([disabled])")
    until(page, "document.querySelector('#steps').textContent.includes('holding')")
    page.click("#stop")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    assert served_page.service.supervisor.latch.is_set()
    until(page, "document.querySelector('#mission-state').textContent === 'failed'")
    assert page.is_disabled("#start")
    page.click("#reset:not([hidden])")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    assert not served_page.service.supervisor.latch.is_set()
    page.wait_for_selector("#start:not([disabled])")


def test_no_reset_is_offered_while_a_stop_is_under_way(page: Any, served_page: Panelwright) -> None:
    """A press sends the stop in two ways; one that arrives after the reset would refuse it or latch again."""
    held: list[Any] = []
    page.route(lambda url: url == served_page.stop_url, lambda route: held.append(route))  # noqa: PLW0108 - it needs a function of Python
    page.click("#stop")
    until(
        page, "document.querySelector('#stop-box').dataset.latched === 'yes' && document.querySelector('#reset').hidden"
    )
    eventually(lambda: page.evaluate("() => true") and held)[0].continue_()
    page.click("#reset:not([hidden])")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    assert not served_page.service.supervisor.latch.is_set()
    page.unroute_all()


def test_the_stop_works_before_the_page_knows_anything(page: Any, served_page: Panelwright) -> None:
    tab = page.context.browser.new_page()
    tab.route("**/v1/info", lambda route: route.abort())
    tab.goto(served_page.url)
    tab.click("#stop")
    until(tab, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    assert served_page.service.supervisor.latch.is_set()
    tab.unroute_all()
    until(tab, "document.querySelector('#cell-line').textContent.includes('cell fake')")  # the page repeats its request
    tab.click("#reset:not([hidden])")  # only after both stop requests have ended
    until(tab, "document.querySelector('#stop-box').dataset.latched === 'no'")
    assert not served_page.service.supervisor.latch.is_set()
    tab.close()


def test_the_escape_key_stops_and_a_narrow_screen_still_shows_the_button(page: Any, served_page: Panelwright) -> None:
    page.set_viewport_size({"width": 420, "height": 800})
    assert page.is_visible("#stop")
    assert page.evaluate("document.documentElement.scrollWidth <= 420")
    page.keyboard.press("Escape")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    assert served_page.service.supervisor.latch.is_set()


def test_an_unreachable_service_is_said_and_nothing_old_passes_for_new(page: Any, served_page: Panelwright) -> None:
    page.route("**/*", lambda route: route.abort())
    page.wait_for_selector("#banner:not([hidden])")
    assert "does not answer" in page.text_content("#banner")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'unknown'")
    assert "hardware stop" in page.text_content("#stop-line")
    assert page.is_disabled("#start")
    until(page, "document.querySelector('#devices-line').textContent === 'not known now'")
    until(page, "document.querySelector('#picture').style.opacity === '0.35'")
    page.unroute_all()
    page.wait_for_selector("#banner", state="hidden")


def test_a_stop_of_a_service_that_was_started_anew_is_no_old_news(page: Any, served_page: Panelwright) -> None:
    """A restarted service counts its stops from the beginning, and the machine's clock may have been set back."""
    fresh = {"is_latched": False, "count": 0, "changed_time_s": time.time() - 3600.0, "source": "anew", "stop_url": ""}
    served_page.service.supervisor.stop("a test")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    page.route("**/v1/stop", lambda route: route.fulfill(json=fresh))
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    page.wait_for_selector("#start:not([disabled])")
    page.unroute_all()
