"""Tests of the jobs that operators do in the console, in a real browser. Skipped if there is no Chromium."""

from __future__ import annotations

import json
import time
from typing import Any

from service.console.cell_scene import drawn_links
from service.jsonable import jsonable
from tests.service.browser import NEEDS_CHROMIUM
from tests.service.console.served import Cell, leave_mission, until
from tests.service.history.test_store import reading
from tests.service.review.test_review import around
from tests.service.waiting import eventually

pytestmark = NEEDS_CHROMIUM


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
    cell.record(50.0)
    cell.service.service.plant.alarms.unshelve("setpoint.high", by="cleaner")  # the tests of other pages need the alarm


def test_a_point_of_the_trend_shows_its_reading_and_reports_are_searched(page: Any, cell: Cell) -> None:
    cell.record(33.5)
    page.goto(f"{cell.url}/history?object=setpoint")
    until(page, "document.querySelector('tbody').textContent.includes('33.5 %')")
    chart = "getElement(Number(document.querySelector('.nicegui-echart').id.slice(1))).chart"
    until(page, f"{chart}.getOption().series[2].data.at(-1)[1] === 33.5")

    def is_clicked() -> bool:  # the chart may still be laid out when the first click comes
        x, y = page.evaluate(f"{chart}.convertToPixel({{seriesIndex: 2}}, {chart}.getOption().series[2].data.at(-1))")
        page.click(".nicegui-echart", position={"x": x, "y": y})
        return ": 33.5" in page.inner_text(".main")

    eventually(is_clicked)
    leave_mission(cell.service.service.runs_dir / "20260102T000000-a", done=["read", "feel"])
    until(page, "document.querySelector('.main').textContent.includes('1 of 1 reports')")
    page.fill("input[aria-label=Object]", "nothing of that name")
    until(page, "document.querySelector('.main').textContent.includes('0 of 1 reports')")


def test_values_are_compared_with_those_of_last_time_and_of_a_week_before(page: Any, cell: Cell) -> None:
    history, now_s = cell.service.service.plant.history, time.time()
    given = {"object": "setpoint", "kind": "slider", "unit": "%", "sigma": 0.3}
    made = [
        (now_s - 8 * 86_400, 10.0, "t1"),
        (now_s - 60, 60.0, "t2"),
        (now_s - 2, 61.0, "t3"),
        (now_s - 1, 63.5, "t3"),
    ]
    history.add([reading(0, value, utc_s=at_s, task=task, **given) for at_s, value, task in made])
    page.goto(f"{cell.url}/history?object=setpoint")
    found = (
        "[...document.querySelectorAll('[aria-label=\"Compare with before\"] tr')].map(one => one.textContent).join()"
    )
    until(page, f"{found}.includes('63.5 %') && {found}.includes('60.0 %') && {found}.includes('+3.5 %')")
    page.click("[data-against=week]")
    until(page, f"{found}.includes('10.0 %') && {found}.includes('+53.5 %')")


def test_the_cell_shows_the_planned_way_the_force_and_the_points_of_the_scanner(page: Any, cell: Cell) -> None:
    page.goto(f"{cell.url}/missions")
    page.click("[data-mission=demo]")
    page.click("button:text-is('Dry run'):not([disabled])")
    until(page, "document.querySelector('.main').textContent.includes('Every place can be reached')")
    page.goto(f"{cell.url}/cell")
    until(page, "document.querySelector('.main').textContent.includes('The green way is the dry run of demo.')")
    until(page, "document.querySelector('.main').textContent.includes('Contact force')")
    drawn = (
        "[...getElement(Number(document.querySelector('.scene').id.slice(1))).objects.values()].map(one => one.mesh)"
    )
    until(page, f"{drawn}.filter(one => one.type === 'Line').length >= 2")
    connection = cell.service.service.supervisor.connection
    links = jsonable(connection.device("arm").capabilities())["links"]
    end_m = drawn_links(links, connection.mover.state().position_rad.tolist())[-1].joint_m
    away_m = f"Math.hypot(...one.position.toArray().map((value, axis) => value - {end_m}[axis]))"
    until(page, f"{drawn}.some(one => {away_m} < 1e-6)")
    assert not page.evaluate(f"{drawn}.some(one => one.type === 'Points')"), "a look at the page reads no scanner"
    page.click('button:text-is("Show the scanner\'s points")')
    until(page, f"{drawn}.some(one => one.type === 'Points' && one.geometry.attributes.position.count > 0)")
    page.goto(f"{cell.url}/missions")
    page.click("button:text-is('Run mission'):not([disabled])")
    until(page, "document.querySelector('.steps').textContent.includes('Holding')")
    page.click("button:text-is('Cancel'):not([disabled])")
    until(page, "document.querySelector('.steps').textContent.includes('cancelled')")
    page.goto(f"{cell.url}/cell")
    until(page, "document.querySelector('.main').textContent.includes('Contact force')")
    assert "The green way" not in page.inner_text(".main"), "the arm has moved since it was planned"


def test_the_cell_is_drawn_anew_only_where_something_may_have_changed(page: Any, cell: Cell) -> None:
    page.goto(f"{cell.url}/cell")
    scene = "getElement(Number(document.querySelector('.scene').id.slice(1)))"
    five_draws = f"""(() => {{ const {{ renderer, scene, camera }} = {scene}, before = renderer.info.render.frame;
      for (let k = 0; k < 5; k += 1) {{ CHANGE; renderer.render(scene, camera); }}
      return renderer.info.render.frame - before; }})()"""
    unchanged = five_draws.replace("CHANGE", "")
    until(page, f"{unchanged} <= 1")
    messages = "window.socket.listenersAny().forEach(told => told('update', {}))"
    for change in ("camera.position.x += 0.01", messages):
        # One is drawn, and the others wait until it is finished, which a script sees only when it has ended.
        until(page, f"{unchanged} === 0 && {five_draws.replace('CHANGE', change)} === 1")


def test_readings_are_reviewed_by_keys_one_after_the_other(page: Any, cell: Cell) -> None:
    history = cell.service.service.plant.history
    asked = {"object": "setpoint", "kind": "slider", "unit": "%", "sigma": 2.0, "confidence": 0.4, "doubt": "it is dim"}
    crop = str(history.crops.add(b"\x89PNG a slider"))
    history.crops.add_surroundings(crop, around("speed"))
    history.add([reading(k, 10.0 + k, utc_s=time.time() - 3600 + k, crop=crop, **asked) for k in range(20)])
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
    page.click(".q-toggle:has-text('Teach the look of the object, too')")
    page.fill("input[aria-label='Something else']", "33")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.main').textContent.includes('No reading waits.')")
    until(page, "document.body.textContent.includes('The look was taught as slider.')")
    rows = history.reader().page(history.ask(object="setpoint"))
    said = [json.loads(row.reading.answered) for row in rows if row.reading.answered is not None]
    assert sorted(one["verdict"] for one in said) == ["right"] * 18 + ["unreadable", "wrong"]
    assert {one["by"] for one in said} == {"alice"}
