"""Tests of the console in a real browser, beside a service of fakes. Skipped if there is no Chromium."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Error
from pydantic import BaseModel

from hal.config import load_cell
from hal.panel.limits import Limits
from hal.strict import Strict
from service.access.keys import Role
from service.operations import Operation, OperationContext
from service.serve import Options, Panelwright
from tests.service.browser import NEEDS_CHROMIUM, browser
from tests.service.conftest import WriteCell
from tests.service.history.test_store import reading
from tests.service.verbs import OPERATIONS, EchoResult, HoldRequest, hold
from tests.service.waiting import eventually

__all__ = ["browser"]  # a fixture
pytestmark = NEEDS_CHROMIUM
SLIDER = """
[[objects]]
kind = "slider"
name = "setpoint"
label = "SETPOINT"
position_m = [0.0, -0.12]
travel_m = 0.1
limits = { high = 90.0 }
what_to_do = "slide it back"
scale = { minimum = 0.0, maximum = 100.0, unit = "%", at_min = -0.05, at_max = 0.05 }
"""
PAGES = ("/", "/missions", "/rounds", "/alarms", "/review", "/history", "/devices", "/setup", "/cell")


def until(page: Any, claim: str) -> None:
    """Wait until a JavaScript condition holds; one about an element that is not there yet does not hold."""
    probe = f"() => {{ try {{ return Boolean({claim}) }} catch {{ return false }} }}"

    def holds() -> bool:
        try:
            return bool(page.evaluate(probe))
        except Error:
            return False  # the page is being loaded again, after a restart of the console

    try:
        eventually(holds, timeout_s=60.0)
    except AssertionError:
        raise AssertionError(f"{claim}; the page says: {page.inner_text('body')}") from None


class SetRequest(Strict):
    """What the console asks for when a slider is set or read."""

    object: str = ""
    objects: tuple[str, ...] = ()
    value: float = 7.0


class MissionAsked(Strict):
    """What the console asks for on the page of missions."""

    file: str | None = None
    resume: str | None = None
    dry_run: bool = False


class MissionTold(BaseModel):
    """What a mission of this test tells."""

    plan: dict[str, Any] | None = None


def mission(context: OperationContext, request: MissionAsked) -> MissionTold:
    """Plan one station, or stand still until it is cancelled."""
    if request.dry_run:
        station = {"step": "read", "what": "close-up of setpoint", "way_s": 1.5, "problem": None}
        times = {"ways_s": 1.5, "contact_s": 0.0, "expected_s": 1.5}
        return MissionTold(plan={"stations": [station], "is_possible": True, "located": True, **times})
    context.task.progress(0.1, "close-up", "setpoint")
    hold(context, HoldRequest())
    return MissionTold()


class Cell:
    """A service of fakes with its console. A slider that is set or read is in the history afterwards."""

    def __init__(self, write_cell: WriteCell, folder: Path, *, keys: dict[str, Role] | None = None) -> None:
        path = write_cell(robot=True)
        (path.parent / "panel.toml").write_text((path.parent / "panel.toml").read_text() + SLIDER)
        self.asked: list[SetRequest] = []
        holds = Operation(
            name="missions",
            request_model=MissionAsked,
            result_model=MissionTold,
            run=mission,
            summary="Hold",
            moves=True,
            is_still=lambda request: request.dry_run,
        )
        sets = {
            verb: Operation(
                name=verb, request_model=SetRequest, result_model=EchoResult, run=self._set, summary="Set", moves=True
            )
            for verb in ("manipulate", "inspect")
        }
        options = Options(port=0, runs_dir=folder, inline=True, console=True)
        self.service = Panelwright(load_cell(path), options, operations={**OPERATIONS, "missions": holds, **sets})
        book = self.service.service.keys
        self.secrets = {
            name: book.add(name, role, valid_s=None, commit=lambda _kind, _data: None)
            for name, role in (keys or {}).items()
        }
        self.service.start()
        assert self.console.wait_until_ready(150.0)

    @property
    def console(self) -> Any:
        assert self.service.console is not None
        return self.service.console

    @property
    def url(self) -> str:
        return str(self.service.console_url)

    def _set(self, context: OperationContext, request: SetRequest) -> EchoResult:
        self.asked.append(request)
        context.task.progress(0.5, "sliding")
        self.record(request.value)
        return EchoResult(text="", number=request.value, nothing=None)

    def record(self, value: float) -> None:
        """Store a reading of the slider, and judge it by its limits."""
        given = {
            "object": "setpoint",
            "kind": "slider",
            "unit": "%",
            "sigma": 0.3,
            "confidence": 0.9,
            "utc_s": time.time(),
        }
        stored = reading(0, value, **given)
        plant = self.service.service.plant
        plant.history.add([stored])
        for listen in plant.observations.listeners:
            listen([stored])


@pytest.fixture(scope="module")
def cell(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    cell = Cell(write_module_cell, tmp_path_factory.mktemp("runs"))
    yield cell
    cell.service.close()


@pytest.fixture(scope="module")
def page(browser: Any, cell: Cell) -> Iterator[Any]:
    tab = browser.new_page(viewport={"width": 1440, "height": 900})
    tab.set_default_timeout(60_000)
    faults: list[str] = []
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.goto(cell.url)
    yield tab
    assert faults == []


def test_the_panel_shows_and_a_new_reading_appears_by_itself(page: Any, cell: Cell) -> None:
    until(page, "document.querySelector('[data-object=setpoint] .value').textContent === 'not read yet'")
    cell.record(41.5)
    until(page, "document.querySelector('[data-object=setpoint] .value').textContent === '41.5 %'")
    until(page, "document.querySelector('tr time').textContent.endsWith(' s')")
    until(page, "document.querySelector('img[data-source]').naturalWidth === 64")


def test_an_object_is_opened_read_and_set_only_after_a_yes(page: Any, cell: Cell) -> None:
    cell.asked.clear()
    page.click("g[data-object=setpoint]")
    page.click("button:text-is('Read now')")
    until(page, "document.querySelector('.dialog').textContent.includes('done. It shows 7.0 %')")
    page.fill(".dialog input", "300")
    page.click(".dialog button:text-is('Set to …')")
    until(page, "document.querySelector('.dialog').textContent.includes('Give a number from 0 to 100')")
    page.fill(".dialog input", "62")
    page.click(".dialog button:text-is('Set to …')")
    until(page, "document.querySelector('.dialog').textContent.includes('works it from 7.0 % to 62 %')")
    assert len(cell.asked) == 1, "nothing moves before the yes"
    page.click("button:text-is('Yes, move')")
    until(page, "document.querySelector('#dialog-value').textContent === '62.0 %'")
    assert [(one.object, one.value) for one in cell.asked[1:]] == [("setpoint", 62.0)]
    page.click("button:text-is('Close')")
    page.wait_for_selector(".dialog", state="hidden")


def test_a_limit_is_set_and_its_alarm_is_seen(page: Any, cell: Cell) -> None:
    cell.record(50.0)
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    until(page, "document.querySelector('.dialog').textContent.includes('beyond high 90 %')")
    page.click("button:text-is('Limits …')")
    page.fill("input[aria-label='high %']", "40")
    page.click("button:text-is('Save limits')")
    until(page, "document.querySelector('.dialog').textContent.includes('setpoint shows 50 %, above high 40')")
    assert cell.service.service.plant.panel.object("setpoint").limits == Limits(high=40.0)
    page.click("button:text-is('Limits …')")
    page.click("button:text-is('Those of the panel file')")
    until(page, "document.querySelector('.dialog').textContent.includes('Over, but not acknowledged')")
    until(page, "document.querySelector('.dialog').textContent.includes('beyond high 90 %')")
    for alarm in cell.service.service.plant.alarms.all():
        if alarm.state == "returned-unacknowledged":
            cell.service.service.plant.alarms.acknowledge(alarm.id, by="cleaner")


def test_an_alarm_is_acknowledged_and_shelved_with_a_reason(page: Any, cell: Cell) -> None:
    cell.record(95.0)
    page.goto(f"{cell.url}/alarms")
    until(page, "document.querySelector('tbody').textContent.includes('slide it back')")
    page.click("button:text-is('Acknowledge')")
    until(page, "document.body.textContent.includes('Give your name first')")
    page.fill("input[aria-label='Your name, for the record']", "alice")
    page.click("button:text-is('Acknowledge')")
    until(page, "document.querySelector('tbody').textContent.includes('acknowledged')")
    page.click("button:text-is('Shelve …')")
    page.click("button:text-is('Shelve')")
    until(page, "document.querySelector('.dialog').textContent.includes('Give a reason')")
    page.fill(".dialog input[aria-label=Reason]", "test run")
    page.click("button:text-is('Shelve')")
    until(page, "document.querySelector('tbody').textContent.includes('alice: test run')")
    shelved = next(one for one in cell.service.service.plant.alarms.all() if one.id == "setpoint.high")
    assert (str(shelved.state), shelved.by, shelved.reason) == ("shelved", "alice", "test run")
    assert 7.9 * 3600 < (shelved.shelved_until_s or 0.0) - time.time() < 8.1 * 3600


def test_a_point_of_the_trend_shows_its_reading_and_reports_are_searched(page: Any, cell: Cell) -> None:
    cell.record(33.5)
    page.goto(f"{cell.url}/history?object=setpoint")
    until(page, "document.querySelector('tbody').textContent.includes('33.5 %')")
    chart = "getElement(Number(document.querySelector('.nicegui-echart').id.slice(1))).chart"
    until(page, f"{chart}.getOption().series[2].data.at(-1)[1] === 33.5")
    x, y = page.evaluate(f"{chart}.convertToPixel({{seriesIndex: 2}}, {chart}.getOption().series[2].data.at(-1))")
    page.click(".nicegui-echart", position={"x": x, "y": y})
    until(page, "document.querySelector('.main').textContent.includes(': 33.5')")
    leave_mission(cell.service.service.runs_dir / "20260102T000000-a", done=["read", "feel"])
    until(page, "document.querySelector('.main').textContent.includes('1 of 1 reports')")
    page.fill("input[aria-label=Object]", "nothing of that name")
    until(page, "document.querySelector('.main').textContent.includes('0 of 1 reports')")


def test_readings_are_reviewed_by_keys_one_after_the_other(page: Any, cell: Cell) -> None:
    history = cell.service.service.plant.history
    asked = {"object": "setpoint", "kind": "slider", "unit": "%", "sigma": 2.0, "confidence": 0.4, "doubt": "it is dim"}
    history.add([reading(k, 10.0 + k, utc_s=time.time() - 3600 + k, **asked) for k in range(20)])
    page.goto(f"{cell.url}/review")
    page.fill("input[aria-label='Your name, for the record']", "alice")
    page.keyboard.press("Tab")
    until(page, "document.querySelector('.answers').textContent.includes('29 %')")
    page.evaluate("document.activeElement.blur()")
    for k in range(18):
        page.keyboard.press("1")
        until(page, f"document.querySelector('.main').textContent.includes('you have answered {k + 1}')")
    page.keyboard.press("u")
    until(page, "document.querySelector('.main').textContent.includes('you have answered 19')")
    page.fill("input[aria-label='Something else']", "33")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.main').textContent.includes('No reading waits.')")
    rows = history.reader().page(history.ask(object="setpoint"))
    said = [json.loads(row.reading.answered) for row in rows if row.reading.answered is not None]
    assert sorted(one["verdict"] for one in said) == ["right"] * 18 + ["unreadable", "wrong"]
    assert {one["by"] for one in said} == {"alice"}


def test_a_round_is_added_shown_in_the_calendar_and_removed(page: Any, cell: Cell) -> None:
    page.goto(f"{cell.url}/rounds")
    page.fill("input[aria-label=Name]", "noon")
    page.fill("input[aria-label=Mission]", "demo")
    page.fill("input[aria-label=Times]", "0 25 * * *")
    page.click("button:text-is('Save round')")
    until(page, "document.body.textContent.includes('is no cron expression')")
    page.fill("input[aria-label=Times]", "0 12 * * *")
    page.click("button:text-is('Save round')")
    until(page, "document.querySelector('tbody').textContent.includes('noon')")
    page.reload()
    until(page, "document.querySelector('.calendar').textContent.includes('12:00 noon comes')")
    page.click("button:text-is('Remove noon')")
    until(page, "document.querySelector('.main').textContent.includes('There is no round yet')")


def test_a_mission_is_chosen_planned_and_taken_up_where_it_ended(page: Any, cell: Cell) -> None:
    leave_mission(cell.service.service.runs_dir / "20260103T000000-a", done=["read"])
    page.goto(f"{cell.url}/missions")
    page.click("[data-mission=demo]")
    until(page, "document.querySelector('.main').textContent.includes('Touches the plate 4 times')")
    page.click("button:text-is('Dry run'):not([disabled])")
    until(page, "document.querySelector('.main').textContent.includes('Every place can be reached')")
    until(page, "document.querySelector('.main').textContent.includes('Reads from close up: SETPOINT')")
    assert cell.service.service.tasks.all()[0].request["file"] == "demo"
    page.click("button:text-is('Take up at “feel”')")
    until(page, "document.querySelector('.steps').textContent.includes('Reads from close up: SETPOINT')")
    assert cell.service.service.tasks.all()[0].request["resume"] == "20260103T000000-a"
    page.click("button:text-is('Cancel'):not([disabled])")
    until(page, "document.querySelector('.steps').textContent.includes('cancelled')")


def leave_mission(folder: Path, *, done: list[str]) -> None:
    """Write what an earlier mission leaves: a report, and how far it got."""
    folder.mkdir()
    told = {"started": "2026-01-03T00:00:00Z", "succeeded": False, "readings": [{"name": "setpoint"}], "actions": []}
    (folder / "report.json").write_text(json.dumps(told))
    (folder / "report.html").write_text("<h1>report</h1>")
    steps = [{"name": "read"}, {"name": "feel"}]
    (folder / "progress.json").write_text(json.dumps({"mission": {"title": "Look", "steps": steps}, "done": done}))


def test_a_mission_goes_on_while_the_console_is_killed_and_comes_back(page: Any, cell: Cell) -> None:
    page.goto(f"{cell.url}/missions")
    page.click("button:text-is('Run mission'):not([disabled])")
    running = (
        "document.querySelector('.bar') !== null && document.querySelector('.steps').textContent.includes('Holding')"
    )
    until(page, running)  # the bar too: an earlier mission leaves its steps on the page
    first = cell.console.pid
    page.evaluate("document.body.dataset.served = 'by the console that is killed'")
    os.kill(first, signal.SIGKILL)
    eventually(lambda: cell.console.pid not in (None, first))
    task = cell.service.service.tasks.all()[0]
    until(page, f"document.body.dataset.served === undefined && {running}")
    assert task.state == "running"
    page.click("button:text-is('Cancel'):not([disabled])")
    until(page, "document.querySelector('.steps').textContent.includes('cancelled')")
    assert not cell.service.service.supervisor.latch.is_set()


def test_the_stop_works_while_the_console_hangs(page: Any, cell: Cell) -> None:
    page.goto(cell.url)
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    pid = cell.console.pid
    os.kill(pid, signal.SIGSTOP)
    try:
        page.click("#stop-button")
        until(page, "document.querySelector('#stop-box').dataset.latched === 'yes'")
        assert cell.service.service.supervisor.latch.is_set()
    finally:
        os.kill(pid, signal.SIGCONT)
    page.click("#stop-reset:not([hidden])")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    assert not cell.service.service.supervisor.latch.is_set()


def test_people_log_in_see_what_their_role_may_do_and_log_out(
    browser: Any, write_cell: WriteCell, tmp_path: Path
) -> None:
    keyed = Cell(write_cell, tmp_path / "runs", keys={"bob": Role.OBSERVER, "carol": Role.OPERATOR})
    tab = browser.new_context().new_page()
    try:
        tab.goto(f"{keyed.url}/missions")
        tab.wait_for_url("**/login.html?next=%2Fmissions")
        tab.fill("#key", keyed.secrets["bob"])
        tab.click("#login button")
        tab.wait_for_url("**/missions")
        until(tab, "document.querySelector('#person').textContent.includes('bob (observer')")
        until(tab, "document.querySelector('.main').textContent.includes('Reads every object from close up')")
        assert tab.locator("button:text-is('Run mission')").count() == 0
        tab.click("#log-out")
        tab.wait_for_url("**/login.html")
        tab.fill("#key", keyed.secrets["carol"])
        tab.click("#login button")
        tab.wait_for_url("**/")
        tab.goto(f"{keyed.url}/missions")
        tab.click("button:text-is('Run mission'):not([disabled])")
        until(tab, "document.querySelector('.steps').textContent.includes('Holding')")
        task = keyed.service.service.tasks.all()[0]
        assert task.by == "carol", "the journal tells who it was"
        assert task.sub_lease is not None
        assert task.sub_lease.is_of_console
        tab.click("button:text-is('Cancel'):not([disabled])")
        until(tab, "document.querySelector('.steps').textContent.includes('cancelled')")
    finally:
        tab.context.close()
        keyed.service.close()


@pytest.mark.parametrize(("width_px", "scheme"), [(1440, "light"), (390, "dark")])
def test_every_page_fits_and_has_no_barrier(browser: Any, cell: Cell, width_px: int, scheme: str) -> None:
    from axe_playwright_python.sync_playwright import Axe

    context = browser.new_context(viewport={"width": width_px, "height": 844}, color_scheme=scheme, bypass_csp=True)
    tab = context.new_page()
    found: list[str] = []
    for path in PAGES:
        tab.goto(cell.url + path)
        until(tab, "document.querySelector('.top .quiet').textContent.includes('panel fake')")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width_px, path
        assert tab.locator("#stop-button").bounding_box()["y"] < 844, "the stop is always in sight"
        for fault in Axe().run(tab).response["violations"]:
            found.append(f"{path} {fault['id']}: {fault['nodes'][0]['html'][:120]}")
    context.close()
    assert found == []
