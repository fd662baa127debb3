"""A simulated day of rounds, run as the week is but without pictures, and the parts of which it is made."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from hal.config import load_cell
from hal.errors import ConfigError, InvalidRequest
from service.calendar import Calendar, by_calendar, calendar_clock
from service.missions.files import checked_file
from service.serve import Options, Panelwright
from service.week.checks import Left, checks_of, left_by
from service.week.files import LIMITS, keep_shown, write_plant
from service.week.run import DAY_S, live_week, times_of
from service.week.story import Story
from tests.service.week.plain_looks import operations

BENCH = Path(__file__).parents[3] / "cells/bench.toml"
NOW_S = 1_790_000_000.0


@dataclass(frozen=True, slots=True)
class Day:
    """A day that was lived, and the files that it has left."""

    left: Left
    cell: Path
    runs: Path


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Day]:
    runs = tmp_path_factory.mktemp("week")
    cell = write_plant(BENCH, runs / "plant", seed=11)
    since_s, _, _ = times_of(1.0, NOW_S)
    calendar = Calendar(since_s)
    with by_calendar(calendar):
        options = Options(port=0, runs_dir=runs, inline=True)
        panelwright = Panelwright(load_cell(cell), options, operations=operations())
    try:
        panelwright.start()
        week = live_week(panelwright, calendar, days=1.0, now_s=NOW_S)
        service = panelwright.service
        yield Day(left_by(week, service.plant, service.cell.panel, cell, runs), cell, runs)
    finally:
        panelwright.close()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_day_of_rounds_leaves_what_the_week_promises(day: Day) -> None:
    checks = list(checks_of(day.left))
    assert len(checks) >= 21
    assert [f"{check.says}: {check.saw}" for check in checks if not check.holds] == []


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_check_fails_when_what_it_is_about_is_missing(day: Day) -> None:
    first, *others = day.left.week.rounds
    elsewhere = replace(first, due_s=first.due_s + 60.0, mission="nowhere")
    lying = replace(others[0], truth={**others[0].truth, "pressure": 1.0, "run_lamp": 0.0})
    week = replace(day.left.week, rounds=(elsewhere, lying, *others[1:]))
    failed = [
        check.says for check in checks_of(replace(day.left, week=week, changes=(), cell=BENCH)) if not check.holds
    ]
    words = ("at its time", "every object", "by the simulator's truth", "has left a report", "time of its round")
    for word in (*words, "pressure.high was"):
        assert [says for says in failed if word in says], word
    assert "the limits stand in the week's own panel file" in failed


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_later_service_on_that_folder_shows_the_same(day: Day) -> None:
    later = Panelwright(load_cell(day.cell), Options(port=0, runs_dir=day.runs, inline=True))
    try:
        states = {alarm.id: str(alarm.state) for alarm in later.service.plant.alarms.all() if alarm.state != "normal"}
        assert states["pressure.high"] == "returned-unacknowledged"
        assert states["run_lamp.state"] == "unacknowledged"
        assert later.service.plant.review.waiting()[0] == 1
        assert len(later.service.plant.rounds.runs("patrol")) == 4
    finally:
        later.close()


def test_the_plant_has_the_limits_the_mission_and_the_round_and_is_written_once(tmp_path: Path) -> None:
    cell = load_cell(write_plant(BENCH, tmp_path, seed=5))
    for name, keys in LIMITS.items():
        given = cell.panel.object(name).model_dump(exclude_none=True)
        assert all(given[key] == value or set(value) <= set(given[key]) for key, value in keys.items())
    assert cell.file.cell.seed == 5
    assert [one.name for one in cell.file.rounds] == ["patrol"]
    assert "relieve" in str(checked_file("patrol", cell).mission)
    with pytest.raises(ConfigError, match="exists already"):
        write_plant(BENCH, tmp_path)


def test_a_later_service_begins_with_what_was_shown_at_the_end(tmp_path: Path) -> None:
    path = write_plant(BENCH, tmp_path)
    for pressure in (4.2, 4.3):
        keep_shown(path, {"pressure": pressure, "run_lamp": 0.0})
    assert load_cell(path).file.simulation.shows == {"pressure": 4.3, "run_lamp": 0.0}


def test_a_cell_that_is_not_simulated_or_has_another_panel_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="only on a simulated cell"):
        write_plant(BENCH.with_name("real-ur10e.toml"), tmp_path)
    copied = write_plant(BENCH, tmp_path / "a")
    panel = tmp_path / "a/panels/bench.toml"
    panel.write_text(panel.read_text().replace('name = "flow"', 'name = "stream"'))
    with pytest.raises(ConfigError, match="has no flow"):
        write_plant(copied, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_the_pressure_rises_until_the_valve_is_closed_and_the_flow_meter_fails_once() -> None:
    story = Story(days=7.0, rounds=28)
    shares = [(k + 0.5) / 28 for k in range(28)]
    rising = [story.values(k, share)["pressure"] for k, share in enumerate(shares)]
    assert rising == sorted(rising)
    assert [k for k, share in enumerate(shares) if story.values(k, share)["flow"] < 0.0] == [story.unreadable_round]
    story.relieved_at = shares[18]
    assert story.values(18, shares[18])["pressure"] == pytest.approx(rising[18])
    assert story.values(20, shares[20])["pressure"] < 5.0


def test_a_week_has_28_rounds_and_ends_before_now() -> None:
    since_s, until_s, dues_s = times_of(7.0, NOW_S)
    assert (until_s - since_s, len(dues_s)) == (7 * DAY_S, 28)
    assert since_s < dues_s[0] <= dues_s[-1] <= until_s <= NOW_S


def test_a_calendar_goes_on_from_where_it_is_set_and_never_back() -> None:
    calendar = Calendar(NOW_S)
    assert 0.0 <= calendar.now_s() - NOW_S < time.monotonic()
    calendar.leap_to(NOW_S + DAY_S)
    assert calendar.now_s() >= NOW_S + DAY_S
    with pytest.raises(InvalidRequest, match="later than that already"):
        calendar.leap_to(NOW_S)
    assert calendar_clock() is None
    with by_calendar(calendar):
        clock = calendar_clock()
        assert clock is not None
        assert clock() >= NOW_S + DAY_S
    assert calendar_clock() is None
