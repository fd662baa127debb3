"""Tests of the teach page in a real browser: upload, click, outline, name, save, check. Skipped without Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.client import Client
from service.serve import Panelwright
from tests.perception.vision.bench_panel import panel
from tests.service.browser import NEEDS_CHROMIUM, browser, new_tab, until
from tests.service.shown_panel import Shown, house, shown
from tests.service.waiting import eventually

__all__ = ["browser", "house", "shown"]  # fixtures
pytestmark = NEEDS_CHROMIUM


@pytest.fixture
def page(browser: Any, house: Panelwright, shown: Shown, tmp_path: Path) -> Iterator[Any]:
    """Yield the page with an uploaded image; every test has its own page, without the clicks of other tests."""
    file = tmp_path / "panel.png"
    cv2.imwrite(str(file), shown[0])
    tab, faults = new_tab(browser, height_px=1100)
    tab.goto(f"{house.url}/teach.html")
    tab.set_input_files("#file", str(file))
    until(tab, "document.querySelector('#picture').naturalWidth === 1280")
    yield tab
    assert not faults
    tab.close()


def _click(page: Any, shown: Shown, *places_m: tuple[float, float]) -> None:
    """Click on points of the plate that are visible in the page."""
    picture = page.locator("#picture")
    for u, v in shown[1].project([[x, y, 0.0] for x, y in places_m]):
        scale = picture.bounding_box()["width"] / shown[0].shape[1]
        picture.click(position={"x": (u + 0.5) * scale, "y": (v + 0.5) * scale})  # when it no longer moves


def _outlined(page: Any, button: str) -> None:
    """Wait for the answer to the clicks, which must be an outline that enables the button."""
    until(page, "!document.querySelector('#found').textContent.startsWith('Looking')")
    assert page.is_enabled(button), page.text_content("#found")


def _corners(name: str, half_m: float) -> tuple[tuple[float, float], tuple[float, float]]:
    x, y = panel().object(name).position_m
    return (x - half_m, y + half_m), (x + half_m, y - half_m)


def test_a_click_shows_the_outline_that_was_found(page: Any, shown: Shown) -> None:
    _click(page, shown, panel().object("mode").position_m)
    until(page, "document.querySelector('#found').textContent.includes('rotary')")
    assert "Found a circle" in page.text_content("#found")
    points = page.get_attribute("#outline", "points").split()
    middle = np.mean([[float(x) for x in point.split(",")] for point in points], axis=0)
    assert np.allclose(middle, shown[1].project([panel().object("mode").point_m])[0], atol=10.0)
    page.click("#clear")
    until(page, "!document.querySelector('#outline')")
    assert page.is_disabled("#teach-kind")


def test_the_keyboard_alone_uploads_and_clicks(page: Any, shown: Shown) -> None:
    page.focus("#file")
    assert page.evaluate("document.activeElement.id") == "file", "what is hidden takes no focus"
    height, width = shown[0].shape[:2]
    u, v = np.rint(shown[1].project([panel().object("mode").point_m])[0]).astype(int)
    page.focus("#canvas")
    for way, keys in (
        (int(u) - width // 2, ("ArrowLeft", "ArrowRight")),
        (int(v) - height // 2, ("ArrowUp", "ArrowDown")),
    ):
        wide, narrow = divmod(abs(way), width // 80)
        for _ in range(wide):
            page.keyboard.press(keys[way > 0])
        for _ in range(narrow):
            page.keyboard.press(f"Shift+{keys[way > 0]}")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#found').textContent.includes('rotary')")


def test_a_new_kind_is_named_saved_and_found(page: Any, shown: Shown) -> None:
    _click(page, shown, *_corners("emergency", 0.02))
    _outlined(page, "#teach-kind")
    page.fill("#kind", "mushroom")
    page.click("#teach-kind")
    until(page, "document.querySelector('#saved').textContent.includes('the new kind mushroom')")
    until(page, "document.querySelector('#results').textContent.includes('mushroom')")
    until(page, "document.querySelector('#known').textContent.includes('mushroom')")
    assert "/artefacts/blind.png" in page.get_attribute("#picture", "src")
    page.click("#show-plain")
    page.click("#known button")
    until(page, "!document.querySelector('#known').textContent.includes('mushroom')")


def test_a_click_beside_the_panel_or_on_nothing_is_explained(page: Any, shown: Shown) -> None:
    _click(page, shown, (0.12, -0.15))
    until(page, "document.querySelector('#found').classList.contains('bad')")
    assert "nothing but plate" in page.text_content("#found")
    assert page.is_disabled("#teach-kind")


def test_a_whole_panel_is_put_together_saved_and_read(page: Any, shown: Shown) -> None:
    page.click("#mode-panel")
    page.fill("#panel-name", "pump_room")
    gauge = panel().object("pressure")
    _click(page, shown, gauge.position_m)
    _outlined(page, "#add-object")
    page.select_option("#object-kind", "gauge")
    until(page, "document.querySelector('[data-key=at_min]')")
    page.fill("[data-key=name]", "pressure")
    page.click(".pointed button >> nth=0")
    _click(page, shown, (gauge.position_m[0] - 0.021, gauge.position_m[1] - 0.021))
    assert "," in page.input_value("[data-key=at_min]")
    page.click("#add-object")
    until(page, "document.querySelector('#objects').textContent.includes('pressure · gauge')")
    _click(page, shown, *_corners("emergency", 0.02))
    _outlined(page, "#add-object")
    page.select_option("#object-kind", "mushroom")
    until(page, "document.querySelectorAll('#questions [data-key]').length === 1")
    page.fill("[data-key=name]", "halt")
    page.click("#add-object")
    page.click("#save-panel")
    until(page, "document.querySelector('#saved').textContent.includes('Saved panel pump_room')")
    until(page, "document.querySelector('#results').textContent.includes('pressure · gauge6.')")
    assert "/artefacts/annotated.png" in page.get_attribute("#picture", "src")


def test_a_known_panel_teaches_its_looks_from_the_image(page: Any, house: Panelwright) -> None:
    assert page.is_hidden("#learn-image")
    page.click("#mode-looks")
    until(page, "document.querySelector('#known-panel').value === 'test'")
    page.click("#learn-image")
    until(page, "document.querySelector('#saved').textContent.startsWith('Panel test: new looks: ')")
    told, count = page.text_content("#saved"), len(panel().objects)
    assert "mushroom 1" in told and f"Of {count} objects" in told and f"{count} now." in told
    assert page.text_content("#results").count("recognised now") == count
    assert "/artefacts/learned.png" in page.get_attribute("#picture", "src")
    until(page, "document.querySelector('#known').textContent.includes('mushroom')")
    page.click("#learn-image")
    until(page, "document.querySelector('#saved').textContent.includes('all of it was known already')")
    client = Client(url=house.url)
    for kind in client.get("/v1/knowledge?toml=false")["kinds"]:
        if kind["is_taught"]:
            client.fetch("DELETE", f"/v1/knowledge/kinds/{kind['name']}")


def test_a_drive_there_that_finds_no_panel_is_explained_and_a_latched_stop_forbids_it(page: Any) -> None:
    """The camera of the fakes shows no lights."""
    page.click("#mode-looks")
    page.click("#learn-here:not([disabled])")
    page.wait_for_selector("#complaint:not([hidden])")
    assert len(page.text_content("#complaint")) > 30
    until(page, "document.querySelector('#saved').textContent === 'Nothing was learned.'")
    page.click("#stop")
    page.wait_for_selector("#learn-here[disabled]")
    page.click("#reset:not([hidden])")
    page.wait_for_selector("#learn-here:not([disabled])")


def test_what_is_typed_stays_when_the_questions_of_another_kind_come_late(page: Any) -> None:
    page.click("#mode-panel")
    until(page, "document.querySelector('[data-key=at_min]')")
    held: list[Any] = []

    def hold(route: Any) -> None:
        held.append(route)

    page.route("**/v1/knowledge/questions*", hold)
    page.select_option("#object-kind", "display")
    until(page, "document.querySelector('#object-kind').value === 'display'")
    page.fill("[data-key=name]", "level")
    eventually(lambda: page.title() and held)  # reading the title lets events of the browser be processed
    held[0].continue_()
    until(page, "!document.querySelector('[data-key=at_min]')")
    assert page.input_value("[data-key=name]") == "level"


def test_what_is_no_image_is_explained(page: Any, tmp_path: Path) -> None:
    bad = tmp_path / "bad.png"
    bad.write_bytes(b"not an image")
    page.set_input_files("#file", str(bad))
    page.wait_for_selector("#complaint:not([hidden])")
    assert "not an image" in page.text_content("#complaint")


def test_the_stop_works_here_too_and_a_narrow_screen_shows_everything(page: Any, house: Panelwright) -> None:
    page.set_viewport_size({"width": 420, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth <= 420")
    page.click("#stop")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'yes'")
    assert house.service.supervisor.latch.is_set()
    page.click("#reset:not([hidden])")
    until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
