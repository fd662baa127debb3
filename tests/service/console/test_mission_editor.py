"""Tests of the mission editor in a real browser: form and file side by side. Skipped if there is no Chromium."""

from __future__ import annotations

import tomllib
from typing import Any

from tests.service.browser import NEEDS_CHROMIUM
from tests.service.console.served import Cell, until
from tests.service.waiting import eventually

pytestmark = NEEDS_CHROMIUM
FILE = "textarea[aria-label='Mission file (TOML)']"
SAVED = "button:text-is('Save mission'):not([disabled])"


def written(page: Any) -> dict[str, Any]:
    return tomllib.loads(page.input_value(FILE))


def holds(page: Any, claim: Any) -> None:
    def is_so() -> bool:
        try:
            return bool(claim(written(page)))
        except tomllib.TOMLDecodeError:
            return False

    eventually(is_so)


def test_a_mission_is_written_by_form_and_text_checked_and_saved(page: Any, cell: Cell) -> None:
    page.goto(f"{cell.url}/missions")
    page.click("a:text-is('Write a new mission')")
    page.wait_for_url("**/mission-editor")
    until(page, "document.body.textContent.includes('It has no fault')")
    page.fill("input[aria-label=Title]", "Slide it")
    holds(page, lambda file: file["title"] == "Slide it")
    page.click("button:text-is('Add a step')")
    step = page.locator("[aria-label='Step 2']")
    step.get_by_label("What it does").click()
    page.click("[role=option]:has-text('sets a control')")
    step.get_by_label("Object to set").click()
    page.click("[role=option]:has-text('SETPOINT')")
    step.get_by_label("Target %").fill("140")
    holds(
        page, lambda file: file["steps"][1] == {"kind": "set", "name": "step_1", "object": "setpoint", "value": 140.0}
    )
    until(page, "document.querySelector('.faults').textContent.includes('steps.1.object')")
    assert page.locator(SAVED).count() == 0
    step.get_by_label("Target %").fill("40")
    until(page, "document.querySelector('.main').textContent.includes('Sets SETPOINT to 40.')")
    page.click("button[aria-label='Up, Step 2']")
    holds(page, lambda file: [one["kind"] for one in file["steps"]] == ["set", "inspect"])
    page.fill("input[aria-label='Name of the file']", "slide")
    page.click(SAVED)
    until(page, "document.body.textContent.includes('slide is saved.')")
    folder = cell.service.service.cell.path.parent / "missions"
    assert (folder / "slide.toml").read_text() == page.input_value(FILE)


def test_text_changes_the_form_and_comments_stay(page: Any, cell: Cell) -> None:
    folder = cell.service.service.cell.path.parent / "missions"
    folder.mkdir(exist_ok=True)
    text = 'title = "Wait"\n\n# the lamp is slow\n[[steps]]\nkind = "wait_until"\nname = "lit"  # at last\ntimeout_s = 60.0\n'
    text += 'conditions = [{ object = "pump_lamp", state = "on" }]\n'
    (folder / "wait.toml").write_text(text)
    page.goto(f"{cell.url}/mission-editor?mission=wait")
    until(page, "document.querySelector('[aria-label=\"At most, s\"]').value === '60'")
    page.fill(FILE, text.replace("60.0", "90.0"))
    until(page, "document.querySelector('[aria-label=\"At most, s\"]').value === '90'")
    page.fill(FILE, text.replace("60.0", "["))
    until(page, "document.body.textContent.includes('The form comes back when the file is valid TOML.')")
    until(page, "document.querySelector('.faults').textContent.includes('is not valid TOML')")
    page.fill(FILE, text)
    until(page, "document.querySelector('[aria-label=\"Value or state\"]').value === 'on'")
    page.fill("input[aria-label='Value or state']", "off")
    holds(page, lambda file: file["steps"][0]["conditions"] == [{"object": "pump_lamp", "state": "off"}])
    assert "# the lamp is slow" in page.input_value(FILE)
    assert "# at last" in page.input_value(FILE)
    until(page, "document.querySelector('.main').textContent.includes('It has no fault')")
    (folder / "wait.toml").write_text(text + "# changed by somebody\n")
    page.click(SAVED)
    until(page, "document.body.textContent.includes('the mission was changed by somebody else')")
    assert (folder / "wait.toml").read_text().endswith("# changed by somebody\n")
