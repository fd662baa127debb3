"""The report of a mission as people read it: its title, verdict, values beside earlier ones, pictures, and the PDF."""

from __future__ import annotations

import json
import re
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from typer.testing import CliRunner

from hal.errors import NotFound
from service.cli import _app
from service.commands.report import folder_of
from service.report.blocks import Appendix, Block, Facts, Figures, Table, Text, Title
from service.report.document import Report, blocks_of
from service.report.pdf import pdf_of
from service.report.plots import box_of, png_of, thinned
from service.report.upright import quarter_turns, turned_image, turned_points
from service.report.write import render
from tests.service.browser import CHROMIUM, barriers, browser

__all__ = ["browser"]  # a fixture

ALARM = {
    "object": "pressure", "kind": "high", "says": "4.1 bar is above 4 bar", "priority": "high", "what_to_do": "Call Ann."
}  # fmt: skip


def reading(name: str, **shown: Any) -> dict[str, Any]:
    """Return a reading as `report.json` has it."""
    usual = {
        "kind": "gauge", "present": True, "shows": "", "value": None, "unit": "", "uncertainty": None, "state": None,
        "text": None, "confidence": 0.99, "reason": None, "when": "before the actions",
    }  # fmt: skip
    return {"name": name, **usual, **shown}


def summary(**changes: Any) -> dict[str, Any]:
    """Return a `report.json` with a gauge, a lamp that could not be read, and a valve that was set."""
    action = {
        "object": "valve", "target": "open", "before": "closed", "after": "open", "outcome": "reached", "confirmed": True,
        "detail": "", "peak_force_n": 21.0, "impulse_n_s": 3.0, "chatter_n": 0.4, "attempts": 1, "cell_s": 9.0,
        "skill": "lever",
    }  # fmt: skip
    readings = [
        reading("pressure", value=4.1, unit="bar", uncertainty=0.02),
        reading("lamp", kind="lamp", reason="glare"),
        reading("valve", kind="lever", state="open"),
    ]
    return {
        "mission": "20261123T081014-7c", "title": "Morning round", "version": "9.9", "asked_by": "alice",
        "labels": {"pressure": "Feed pressure"}, "calibrations": [], "crops": ["crop-pressure.png"], "alarms": [],
        "previous": {
            "pressure": {"value": 3.9, "unit": "bar", "uncertainty": 0.02, "state": None, "text": None, "utc_s": 0.0},
            "valve": {"value": None, "unit": "", "uncertainty": None, "state": "closed", "text": None, "utc_s": 0.0},
        },
        "cell": "bench", "panel": "P-7", "mode": "sim", "seed": 4, "started": "2026-11-23T08:10:14Z", "succeeded": True,
        "wall_s": 40.0, "cell_s": 80.0, "peak_force_n": 21.0, "steps": [], "readings": readings, "actions": [action],
        "mission_steps": [], "pictures": ["read-0.png"], "problem": None, **changes,
    }  # fmt: skip


def folder_with(folder: Path, report: dict[str, Any]) -> Path:
    """Write a mission's folder with that report and its pictures."""
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "titles.json").write_text(json.dumps({"read-0.png": "close-up of the valve"}))
    for name in ("read-0.png", "crop-pressure.png"):
        (folder / name).write_bytes(png_of(np.full((48, 64), 90, np.uint8)))
    return folder


def blocks(report: dict[str, Any]) -> list[Block]:
    return list(blocks_of(Report(summary=report, captions={"read-0.png": "close-up of the valve"})))


def table_with(column: str, report: dict[str, Any]) -> list[list[str]]:
    """Return the texts of the first table that has a column of that name."""
    table = next(one for one in blocks(report) if isinstance(one, Table) and column in one.columns)
    return [[cell.text for cell in row] for row in table.rows]


def test_the_title_names_panel_cell_and_time_and_the_facts_who_asked() -> None:
    title, verdict, *rest = blocks(summary())
    assert title == Title("Morning round: panel P-7", "simulated cell bench, 2026-11-23 08:10:14 UTC")
    assert verdict == Text("Everything was done and confirmed; no alarm", "verdict ok")
    facts = next(one for one in rest if isinstance(one, Facts))
    assert facts.items[0] == ("alice", "asked for it")


def test_an_alarm_turns_the_verdict_and_says_what_to_do() -> None:
    _, verdict, alarm, *_ = blocks(summary(alarms=[ALARM]))
    assert verdict == Text("Everything was done and confirmed; 1 alarm", "verdict bad")
    assert alarm == Text("High alarm, Feed pressure: 4.1 bar is above 4 bar. Call Ann.", "bad")


def test_readings_stand_beside_those_before_the_mission_with_their_change() -> None:
    pressure, lamp, valve = table_with("before this mission", summary())
    assert pressure[1:] == ["Feed pressure", "4.10 bar", "± 0.04", "99 %", "3.90 bar  (1970-01-01 00:00)", "+0.20"]
    assert lamp[1:] == ["lamp", "not readable: glare", "", "", "", ""]
    assert (valve[2], valve[5].split("  ")[0], valve[6]) == ("open", "closed", "changed")


def test_a_first_mission_has_no_columns_for_earlier_values() -> None:
    assert len(table_with("confidence", summary(previous={}))[0]) == 5


def test_angles_are_in_degrees() -> None:
    angle = reading("knob", value=0.5, unit="rad", uncertainty=0.01)
    assert table_with("confidence", summary(readings=[angle]))[0][2:4] == ["28.6°", "± 1.1"]


def test_the_page_needs_no_other_file(tmp_path: Path) -> None:
    page = render(folder_with(tmp_path / "m", summary())).read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(sources) == 3
    assert all(one.startswith("data:image/jpeg;base64,") for one in sources)


def test_the_pdf_of_a_whole_panel_has_at_most_three_pages_before_the_appendix(tmp_path: Path) -> None:
    readings = [reading(f"gauge_{k}", value=4.1, unit="bar", uncertainty=0.02) for k in range(16)]
    names = [f"read-{k}.png" for k in range(6)]
    report = summary(readings=readings, pictures=names, alarms=[ALARM] * 3, actions=summary()["actions"] * 6)
    folder = folder_with(tmp_path / "m", report)
    for name in names:
        (folder / name).write_bytes(png_of(np.full((48, 64), 90, np.uint8)))
    whole = list(blocks_of(Report(summary=report, captions=dict.fromkeys(names, "close-up"))))
    main = takewhile(lambda one: not isinstance(one, Appendix), whole)
    assert pages(pdf_of(main, folder)) <= 3
    assert pages(pdf_of(whole, folder)) > pages(
        pdf_of(takewhile(lambda one: not isinstance(one, Appendix), whole), folder)
    )


def pages(pdf: bytes) -> int:
    """Return the number of pages of a PDF."""
    return len(re.findall(rb"/Type /Page\b(?!s)", pdf))


def test_the_command_writes_a_pdf_of_the_newest_mission(tmp_path: Path) -> None:
    folder_with(tmp_path / "20261122T081014-aa", summary())
    newest = folder_with(tmp_path / "20261123T081014-7c", summary())
    result = CliRunner().invoke(_app(), ["report", "last", "--pdf", "--runs", str(tmp_path)])  # type: ignore[arg-type]
    assert result.exit_code == 0, result.output
    assert (newest / "report.pdf").read_bytes().startswith(b"%PDF-")


def test_a_mission_without_a_report_is_refused_with_the_newest_names(tmp_path: Path) -> None:
    folder_with(tmp_path / "20261123T081014-7c", summary())
    with pytest.raises(NotFound, match="no report of mission 'nine'") as caught:
        folder_of("nine", tmp_path)
    assert "20261123T081014-7c" in caught.value.hint


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_turned_picture_is_upright_and_its_points_stay_on_their_pixels(turns: int) -> None:
    image = np.zeros((30, 50), np.uint8)
    image[4, 41] = 255
    ((u, v),) = turned_points(np.array([[41.0, 4.0]]), (50, 30), turns)
    assert turned_image(image, turns)[int(v), int(u)] == 255


@pytest.mark.parametrize(
    ("up_in_image", "turns"), [((0.0, -1.0), 0), ((1.0, 0.0), 1), ((0.0, 1.0), 2), ((-1.0, 0.0), 3)]
)
def test_the_turns_bring_the_top_of_the_panel_above(up_in_image: tuple[float, float], turns: int) -> None:
    up = np.array([*up_in_image, 0.0])
    out = np.array([0.0, 0.0, -1.0])  # the panel's normal looks at the camera
    matrix = np.stack([np.cross(up, out), up, out], axis=1)
    assert quarter_turns(RigidTransform.from_rotation(Rotation.from_matrix(matrix))) == turns


def test_a_range_picture_is_cut_to_what_it_shows() -> None:
    """Half of a range image can be floor, which says nothing about the panel."""
    plate = np.zeros((120, 160), bool)
    plate[30:60, 40:100] = True
    plate[119, 0] = True
    assert box_of(plate) == (slice(26, 63), slice(34, 105))
    assert box_of(np.zeros((120, 160), bool)) == (slice(None), slice(None))


def test_a_long_curve_is_drawn_with_all_its_peaks() -> None:
    times = np.linspace(0.0, 60.0, 15_000)
    force_n = np.sin(times)
    force_n[[7, 9_000, 14_999]] = 50.0, -40.0, 30.0
    shown_s, shown_n = thinned(times, force_n)
    assert len(shown_s) <= 1600
    assert (np.diff(shown_s) > 0).all()
    assert {50.0, -40.0, 30.0} <= set(shown_n)
    assert thinned(times[:9], force_n[:9])[1].tolist() == force_n[:9].tolist()


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM.exists(), reason="no Chromium: apt-get install chromium")
def test_a_report_has_no_barrier(browser: Any, tmp_path: Path) -> None:
    page = render(folder_with(tmp_path / "run", summary(alarms=[ALARM])))
    for width_px in (1440, 390):
        tab = browser.new_page(viewport={"width": width_px, "height": 844})
        tab.goto(page.as_uri())
        assert barriers(tab) == []
        assert tab.evaluate("document.documentElement.scrollWidth") <= width_px
        tab.close()


def test_the_report_has_an_appendix_with_all_pictures() -> None:
    whole = blocks(summary())
    start = next(k for k, one in enumerate(whole) if isinstance(one, Appendix))
    assert any(isinstance(one, Figures) for one in whole[start:])
