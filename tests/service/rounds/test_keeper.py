"""Tests of the keeper: windows, missed runs, one at a time, refusals, restarts, and a month with both clock changes."""

from __future__ import annotations

import random
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import pytest

from hal.errors import ConfigError, LeaseError
from service.errors import HistoryError, NotPossibleNow
from service.rounds.schedule import times_between
from service.tasks.model import TaskState
from tests.service.rounds.rig import DURATION_S, Killed, Rig, section

START_S = datetime(2026, 10, 1, 0, 30, tzinfo=UTC).timestamp()
HOUR_S = 3600.0
TO_DUE_S = 1800.0  # from START_S to the first full hour


def rig(folder: Path, **given: object) -> Rig:
    return Rig(folder=folder, sections=[section(**given)], now_s=START_S)


def test_a_run_begins_at_its_time_once_and_its_end_is_recorded(tmp_path: Path) -> None:
    one = rig(tmp_path)
    for _ in range(130):
        one.tick(60.0)
    runs = one.keeper.runs()
    assert [str(run.state) for run in runs] == ["succeeded", "succeeded"]
    assert [run.due_s for run in runs] == [START_S + TO_DUE_S + HOUR_S, START_S + TO_DUE_S]
    assert all(run.begun_s == run.due_s for run in runs)
    assert all(run.ended_s == run.due_s + DURATION_S for run in runs)


def test_a_run_waits_within_its_window_and_says_for_what(tmp_path: Path) -> None:
    one = rig(tmp_path, window_s=600.0)
    one.forbids = "alice holds the lease"
    one.tick(TO_DUE_S)
    (prospect,) = one.keeper.prospects()
    assert (prospect.waiting_s, prospect.waits_for) == (START_S + TO_DUE_S, "alice holds the lease")
    one.tick(599.0)
    assert one.states() == []
    one.forbids = None
    one.tick(1.0)
    assert one.states() == ["running"]


@pytest.mark.parametrize(("missed", "wanted"), [("skip", ["missed"]), ("late", ["running"])])
def test_after_the_window_a_run_is_missed_or_late(tmp_path: Path, missed: str, wanted: list[str]) -> None:
    one = rig(tmp_path, window_s=600.0, missed=missed)
    one.forbids = "alice holds the lease"
    one.tick(TO_DUE_S)
    one.tick(601.0)
    one.forbids = None
    one.tick(1.0)
    assert one.states() == wanted
    if missed == "skip":
        assert one.keeper.runs()[0].why == "the window was over before it could begin: alice holds the lease"


def test_of_many_missed_runs_only_the_newest_is_late(tmp_path: Path) -> None:
    one = rig(tmp_path, missed="late")
    one.book.close()
    one.now_s += 5 * HOUR_S + 700.0
    one.start()
    one.tick()
    assert one.states() == ["missed"] * 4 + ["running"]
    assert one.keeper.runs()[1].why == "a newer run was due"


def test_two_rounds_run_one_after_the_other(tmp_path: Path) -> None:
    one = Rig(folder=tmp_path, sections=[section("a"), section("b")], now_s=START_S)
    one.tick(TO_DUE_S)
    assert (one.states("a"), one.states("b")) == (["running"], [])
    one.tick(DURATION_S)
    one.tick(1.0)
    assert (one.states("a"), one.states("b")) == (["succeeded"], ["running"])


def test_a_round_waits_for_another_that_only_waits_for_its_turn(tmp_path: Path) -> None:
    one = Rig(folder=tmp_path, sections=[section("a"), section("b")], now_s=START_S)
    one.queues = True  # nothing moves yet, so only the keeper knows that a round has begun
    one.why_not = lambda _section: None  # type: ignore[method-assign]
    one.tick(TO_DUE_S)
    one.tick(1.0)
    assert (one.states("a"), one.states("b")) == (["running"], [])
    assert {one.section.name: one.waits_for for one in one.keeper.prospects()}["b"] == "another round runs"


def test_a_lease_taken_at_the_last_moment_lets_the_run_wait(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.error = LeaseError("alice holds the cell", hint="wait")
    one.tick(TO_DUE_S)
    assert (one.states(), one.keeper.prospects()[0].waits_for) == ([], "alice holds the cell")
    one.error = None
    one.tick(1.0)
    assert one.states() == ["running"]


def test_a_mission_that_cannot_run_fails_once(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.error = ConfigError("there is no mission file 'inspekt'", hint="inspect")
    one.tick(TO_DUE_S)
    one.tick(60.0)
    assert (one.states(), one.keeper.runs()[0].why) == (["failed"], "there is no mission file 'inspekt'")


def test_a_run_that_the_service_left_in_the_middle_is_interrupted_and_one_in_the_queue_begins_again(
    tmp_path: Path,
) -> None:
    one = rig(tmp_path)
    one.queues = True
    one.tick(TO_DUE_S)
    one.restart()
    one.queues = False
    one.tick(1.0)
    one.tick(1.0)
    assert one.states() == ["running"]
    one.restart()
    one.tick(1.0)
    assert one.states() == ["interrupted"]
    one.tick(60.0)
    assert one.states() == ["interrupted"], "nothing moves again by itself"


def test_a_clock_that_is_set_back_repeats_no_run(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.tick(TO_DUE_S)
    one.tick(DURATION_S)
    one.now_s -= 2 * HOUR_S
    for _ in range(24):
        one.tick(300.0)
    dues_s = [run.due_s for run in one.keeper.runs()]
    assert sorted(set(dues_s)) == sorted(dues_s) == [START_S + TO_DUE_S]


def test_a_clock_that_is_set_back_while_the_plan_changes_repeats_no_run(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.tick(TO_DUE_S)
    one.tick(DURATION_S)
    one.now_s -= 2 * HOUR_S
    one.sections = [section(cron="*/30 * * * *")]
    one.restart()
    for _ in range(26):
        one.tick(300.0)
    dues_s = [run.due_s for run in one.keeper.runs()]
    assert len(set(dues_s)) == len(dues_s)
    assert min(dues_s) == START_S + TO_DUE_S, "nothing before it is made up for"


def test_rounds_over_the_api_are_kept_and_those_of_the_cell_file_are_not_changed(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.keeper.define(section("evening", cron="0 18 * * *"))
    one.restart()
    assert [prospect.section.name for prospect in one.keeper.prospects()] == ["evening", "morning"]
    with pytest.raises(NotPossibleNow, match="stands in the cell file"):
        one.keeper.define(section())
    one.keeper.remove("evening")
    one.restart()
    assert [prospect.section.name for prospect in one.keeper.prospects()] == ["morning"]


def test_another_cron_expression_makes_up_for_nothing(tmp_path: Path) -> None:
    one = rig(tmp_path, missed="late")
    one.sections = [section(cron="5 * * * *", missed="late")]
    one.now_s += 3 * HOUR_S
    one.restart()
    one.tick()
    assert one.states() == []


def test_a_damaged_record_is_set_aside_and_the_rounds_go_on_from_now(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.book.close()
    path = tmp_path / "rounds.sqlite"
    torn = b"no database" * 500
    path.write_bytes(torn)
    for beside in ("-wal", "-shm"):
        path.with_name(path.name + beside).unlink(missing_ok=True)
    one.start()
    assert one.book.set_aside_now is not None
    assert one.book.set_aside_now.read_bytes() == torn
    assert one.states() == []


def test_a_record_of_a_newer_version_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    one = rig(tmp_path)
    one.book._db.execute("PRAGMA user_version=99")
    one.book.close()
    before = (tmp_path / "rounds.sqlite").read_bytes()
    with pytest.raises(HistoryError, match="newer panelwright"):
        one.start()
    assert (tmp_path / "rounds.sqlite").read_bytes() == before


def test_a_month_with_both_clock_changes_restarts_and_deaths_loses_doubles_and_shifts_no_run(tmp_path: Path) -> None:
    """October 2026: Sydney's clocks skip an hour on the 4th, Vienna's repeat one on the 25th; 40 restarts, 20 deaths."""
    draw = random.Random(22)
    sections = [
        section("vienna", cron="30 2 * * *", zone="Europe/Vienna", window_s=3000.0),
        section("sydney", cron="15 2 * * *", zone="Australia/Sydney", window_s=3000.0),
        section("hourly", cron="0 * * * *", zone="Europe/Vienna", window_s=3000.0),
    ]
    end_s = START_S + 30 * 86_400.0
    deaths = {"left": 0, "seen": 0}

    def dies(_where: str) -> bool:
        is_now = deaths["left"] > 0 and draw.random() < 0.3
        deaths["left"] -= is_now
        deaths["seen"] += is_now
        return is_now

    one = Rig(folder=tmp_path, sections=sections, now_s=START_S, dies=dies)
    moments = sorted(draw.uniform(START_S, end_s - 7200.0) for _ in range(40 + 20 + 200))
    events = dict(zip(moments, draw.sample(["restart"] * 40 + ["death"] * 20 + ["lease"] * 200, 260), strict=True))
    waiting = list(events.items())
    busy_until_s = 0.0
    while one.now_s < end_s:
        while waiting and waiting[0][0] <= one.now_s:
            what = waiting.pop(0)[1]
            if what == "lease":
                busy_until_s = one.now_s + draw.uniform(0.0, 900.0)
            elif what == "death":
                deaths["left"] += 1
            else:
                one.now_s += draw.uniform(0.0, 600.0)
                one.restart()
        one.forbids = "alice holds the lease" if one.now_s < busy_until_s else None
        try:
            one.tick(draw.uniform(30.0, 90.0))
        except Killed:
            one.restart()
    deaths["left"] = 0
    for _ in range(5):
        one.tick(DURATION_S)
    assert deaths["seen"] == 20
    for each in sections:
        runs = one.keeper.runs(each.name, limit=10_000)
        wanted = times_between(each.cron, each.zone, START_S, one.now_s)
        assert [run.due_s for run in reversed(runs)] == wanted, "no run is lost or doubled"
        assert {str(run.state) for run in runs} <= {"succeeded", "interrupted"}
        assert all(0.0 <= (run.begun_s or 0.0) - run.due_s <= 3000.0 for run in runs), "none is shifted"
    begun = Counter(
        task.key.rpartition(" ")[0] for task in one.tasks.values() if task.started_s is not None and task.key
    )
    assert set(begun.values()) == {1}, "nothing moves twice"
    assert all(task.state in (TaskState.SUCCEEDED, TaskState.FAILED) for task in one.tasks.values())
