"""Tests of the console in a real browser, beside a service of fakes. Skipped if there is no Chromium."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.access.keys import Role
from tests.service.browser import CONSOLE_PAGES, NEEDS_CHROMIUM, barriers
from tests.service.conftest import WriteCell
from tests.service.console.served import Cell, leave_mission, until
from tests.service.console.test_five_tasks import DIALOG
from tests.service.waiting import eventually

pytestmark = NEEDS_CHROMIUM
DIALOGS = {  # by page, with the clicks that open one
    "/": ("g[data-object=setpoint]", "button:text-is('Limits …')"),
    "/alarms": ("button:text-is('Shelve …')",),
    "/devices": ("button:text-is('Change …') >> nth=0",),
}


def test_the_panel_shows_and_a_new_reading_appears_by_itself(page: Any, cell: Cell) -> None:
    until(page, "document.querySelector('[data-object=pump_lamp] .value').textContent === '–'")
    cell.record(41.5)
    until(page, "document.querySelector('[data-object=setpoint] .value').textContent === '41.5 %'")
    until(page, "document.querySelector('tr time').textContent.endsWith(' s')")
    until(page, "document.querySelector('img[data-source]').naturalWidth === 64")


def test_the_alarms_of_an_object_are_taken_out_of_service_and_put_back(page: Any, cell: Cell) -> None:
    desk = cell.service.service.plant.alarms
    cell.record(95.0)
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    page.click(".dialog button:text-is('Alarms out of service …')")
    page.click(".dialog button:text-is('Take out of service')")
    until(page, f"{DIALOG}.includes('Give your name first')")
    assert desk.get("setpoint.high").state == "unacknowledged"
    page.fill(".dialog input[aria-label='Your name, for the record']", "alice")
    page.fill(".dialog input[aria-label=Reason]", "it is repaired")
    page.click(".dialog button:text-is('Take out of service')")
    until(page, f"{DIALOG}.includes('Its alarms are out of service (alice: it is repaired)')")
    assert {one.state for one in desk.all() if one.object == "setpoint"} == {"out-of-service"}
    until(page, f"{DIALOG}.includes('Alarm out of service: setpoint shows 95 %, above high 90')")
    until(page, "document.querySelector('nav .count') === null")
    page.click(".dialog button:text-is('Put alarms back in service')")
    page.fill(".dialog input[aria-label='Your name, for the record']", "alice")
    page.fill(".dialog input[aria-label=Reason]", "it is new")
    page.click(".dialog button:text-is('Put back in service')")
    until(page, "document.querySelector('nav .count').textContent === '1'")
    cell.record(50.0)
    desk.acknowledge("setpoint.high", by="cleaner")


def test_a_limit_is_a_line_on_the_scale_that_shows_its_alarm(page: Any, cell: Cell) -> None:
    page.goto(cell.url)
    line = "document.querySelector('[data-object=setpoint] .limit').getAttribute('stroke')"
    cell.record(50.0)
    until(page, f"{line} === 'var(--warn)'")
    cell.record(95.0)
    until(page, f"{line} === 'var(--bad)'")
    cell.record(50.0)
    cell.service.service.plant.alarms.acknowledge("setpoint.high", by="cleaner")


def test_a_device_gets_other_options_and_keeps_its_own_when_they_do_not_work(page: Any, cell: Cell) -> None:
    cell.trouble.write_text("away")
    page.goto(f"{cell.url}/devices")
    page.click("[data-swap=panel_lights]")
    until(page, f"document.querySelector('.dialog textarea').value.includes('{cell.trouble}')")
    own = page.input_value(".dialog textarea")
    page.fill(".dialog textarea", "trouble = none")
    page.click(".dialog button:text-is('Change and connect')")
    until(page, f"{DIALOG}.includes('The options are not valid')")
    page.fill(".dialog textarea", own)
    page.click(".dialog button:text-is('Change and connect')")
    until(page, f"{DIALOG}.includes('The present driver is kept')")
    cell.trouble.write_text("")
    page.click(".dialog button:text-is('Change and connect')")
    until(page, "!document.querySelector('.dialog')?.checkVisibility()")
    until(page, "document.querySelector('.banner').textContent === ''")


def test_the_console_teaches_by_clicks(page: Any, cell: Cell, tmp_path: Path) -> None:
    picture = np.full((480, 640, 3), 90, np.uint8)
    cv2.circle(picture, (320, 240), 60, (20, 20, 220), -1)
    cv2.imwrite(str(tmp_path / "panel.png"), picture)
    page.goto(f"{cell.url}/setup")
    page.click("button:text-is('Teach by clicks')")
    page.wait_for_url("**/teach")
    until(page, "document.querySelector('#known-line').textContent.includes('kinds')")
    page.set_input_files("#file", str(tmp_path / "panel.png"))
    until(page, "document.querySelector('#picture').naturalWidth === 640")
    page.click("#picture")
    until(page, "/^(Found|No outline)|: /.test(document.querySelector('#found').textContent)")
    page.click("#mode-looks")
    page.wait_for_selector("#learn-here:not([disabled])")
    page.click("#stop-button")
    page.wait_for_selector("#learn-here[disabled]")
    page.click("#stop-reset:not([hidden])")
    page.wait_for_selector("#learn-here:not([disabled])")


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
    eventually(lambda: cell.service.service.tasks.all()[0].request["resume"] == "20260103T000000-a")
    until(page, "document.querySelector('.steps').textContent.includes('Reads from close up: SETPOINT')")
    page.click("button:text-is('Pause'):not([disabled])")
    until(page, "document.querySelector('.main').textContent.includes('The arm stands still')")
    assert cell.service.service.tasks.all()[0].pause == "held"
    page.click("button:text-is('Go on'):not([disabled])")
    until(page, "[...document.querySelectorAll('button')].some(one => one.textContent === 'Pause')")
    assert cell.service.service.tasks.all()[0].pause == "no"
    page.click("button:text-is('Cancel'):not([disabled])")
    until(page, "document.querySelector('.steps').textContent.includes('cancelled')")


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
    context = browser.new_context(viewport={"width": width_px, "height": 844}, color_scheme=scheme, bypass_csp=True)
    tab = context.new_page()
    found: list[str] = []
    for path in CONSOLE_PAGES:
        tab.goto(cell.url + path)
        until(tab, "document.querySelector('.top .quiet').textContent.includes('panel fake')")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width_px, path
        assert tab.locator("#stop-button").bounding_box()["y"] < 844, "the stop is always in sight"
        found += [f"{path} {fault}" for fault in barriers(tab)]
    cell.record(95.0)
    for path, opens in DIALOGS.items():
        tab.goto(cell.url + path)
        for click in opens:
            tab.click(click)
        tab.wait_for_selector(".dialog >> visible=true")
        found += [f"{path}, dialog: {fault}" for fault in barriers(tab)]
    cell.record(50.0)
    cell.service.service.plant.alarms.acknowledge("setpoint.high", by="cleaner")
    context.close()
    assert found == []
