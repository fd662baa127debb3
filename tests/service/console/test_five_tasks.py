"""The five tasks that a new user finishes without reading a page of the documentation, in a real browser."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from hal.panel.limits import Limits
from tests.service.browser import NEEDS_CHROMIUM
from tests.service.console.served import Cell, until
from tests.service.history.test_store import reading
from tests.service.waiting import eventually

pytestmark = NEEDS_CHROMIUM
WEEK_S = 7 * 86_400.0
DIALOG = "document.querySelector('.dialog').textContent"


def test_see_why_the_cell_cannot_start_and_put_it_right(page: Any, cell: Cell) -> None:
    page.goto(cell.url)
    until(page, "document.querySelector('.banner').textContent.includes('panel_lights')")
    page.click("nav a:text-is('Set-up')")
    until(page, "document.querySelector('[role=status] b').textContent.startsWith('Next step: panel_lights: ')")
    cell.trouble.write_text("")
    page.click("button:text-is('Connect panel_lights')")
    until(page, "!document.querySelector('.main').textContent.includes('panel_lights')")
    until(page, "document.querySelector('.banner').textContent === ''")


def test_read_a_gauge(page: Any, cell: Cell) -> None:
    cell.asked.clear()
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    page.click("button:text-is('Read now')")
    until(page, f"{DIALOG}.includes('done. It shows 7.0 %')")
    until(page, "document.querySelector('#dialog-value').textContent === '7.0 %'")
    until(page, "document.querySelector('[data-object=setpoint] .value').textContent === '7.0 %'")
    assert [one.objects for one in cell.asked] == [("setpoint",)]


def test_set_a_control_only_after_a_yes(page: Any, cell: Cell) -> None:
    cell.record(7.0)
    cell.asked.clear()
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    page.fill(".dialog input", "300")
    page.click(".dialog button:text-is('Set to …')")
    until(page, f"{DIALOG}.includes('Give a number from 0 to 100')")
    page.fill(".dialog input", "62")
    page.click(".dialog button:text-is('Set to …')")
    until(page, f"{DIALOG}.includes('moves it from 7.0 % to 62 %')")
    assert cell.asked == [], "nothing moves before the yes"
    page.click("button:text-is('Yes, move')")
    until(page, "document.querySelector('#dialog-value').textContent === '62.0 %'")
    assert [(one.object, one.value) for one in cell.asked] == [("setpoint", 62.0)]
    page.click("button:text-is('Close')")
    page.wait_for_selector(".dialog", state="hidden")


def test_define_a_limit_and_see_its_alarm(page: Any, cell: Cell) -> None:
    cell.record(50.0)
    plant = cell.service.service.plant
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    until(page, f"{DIALOG}.includes('beyond high 90 %')")
    page.click("button:text-is('Limits …')")
    page.fill("input[aria-label='high %']", "40")
    page.click("button:text-is('Save limits')")
    until(page, f"{DIALOG}.includes('setpoint shows 50 %, above high 40')")
    until(page, "document.querySelector('nav .count').textContent === '1'")
    assert plant.panel.object("setpoint").limits == Limits(high=40.0)
    page.click("button:text-is('Limits …')")
    page.click("button:text-is('Those of the panel file')")
    until(page, f"{DIALOG}.includes('Over, but not acknowledged')")
    until(page, f"{DIALOG}.includes('beyond high 90 %')")
    plant.alarms.acknowledge("setpoint.high", by="cleaner")
    until(page, "document.querySelector('nav .count') === null")


def test_find_the_value_of_last_week_with_its_picture(page: Any, cell: Cell) -> None:
    history = cell.service.service.plant.history
    png = cv2.imencode(".png", np.full((30, 40), 200, np.uint8))[1].tobytes()
    old = {"object": "setpoint", "kind": "slider", "unit": "%", "sigma": 0.3, "confidence": 0.9}
    stored = reading(0, 21.5, utc_s=time.time() - WEEK_S + 600.0, **old)
    history.add([replace(stored, crop=history.crops.add(png))])
    cell.record(44.0)
    page.goto(cell.url)
    page.click("g[data-object=setpoint]")
    page.click("a:text-is('More of its history')")
    page.click("button:text-is('Week')")
    until(page, "document.querySelector('tbody').textContent.includes('21.5 %')")
    chart = "getElement(Number(document.querySelector('.nicegui-echart').id.slice(1))).chart"
    found = f"{chart}.getOption().series[2].data.find((one) => one[1] === 21.5)"
    until(page, found)

    def is_shown() -> bool:  # the chart may still be laid out when the first click comes
        x, y = page.evaluate(f"{chart}.convertToPixel({{seriesIndex: 2}}, {found})")
        page.click(".nicegui-echart", position={"x": x, "y": y})
        return bool(page.evaluate("document.querySelector('.main img')?.naturalWidth === 40"))

    eventually(is_shown)
    assert "21.5" in page.inner_text(".main")
