"""Judges the week by what it has left: history, alarms, review, rounds, reports and the files of the plant."""

from __future__ import annotations

import time
from calendar import timegm
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from hal.config import load_cell
from hal.panel import Panel, Shown
from service.alarms.lifecycle import State
from service.history.reading import StoredReading
from service.plant import Plant
from service.rounds.book import RunState
from service.week.files import FLOW, HIGH_BAR, LAMP, LIMITS, PRESSURE, READ, ROUND, TOO_HIGH_BAR, VALVE
from service.week.run import RELIEVE, Lived, Week
from service.week.story import DARK_AT

NEAR_BAR = 0.3  # around a limit, within which a reading may fall on either side
SPANS = 100
LATEST_S = 600.0  # from the time of a round to that of its report, on a busy machine


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One statement about the week, and whether it holds; `saw` says what was found."""

    says: str
    holds: bool
    saw: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Left:
    """What the week has left, as its checks ask for it; `changes` are those of alarms, oldest first."""

    week: Week
    plant: Plant
    panel: Panel
    cell: Path
    runs: Path
    readings: tuple[StoredReading, ...]
    changes: tuple[dict[str, object], ...]

    def of_mission(self, mission: str, name: str) -> list[StoredReading]:
        """Return the readings of one object in one mission."""
        return [one for one in self.readings if one.mission == mission and one.object == name]

    def rises(self, alarm: str) -> list[dict[str, object]]:
        """Return the changes in which the condition of an alarm began to hold."""
        return [
            one for one in self.changes if one["id"] == alarm and one["is_active"] and one["before"] == State.NORMAL
        ]

    def round_of(self, utc_s: float) -> int | None:
        """Return the number of the round, from 0, in which something happened; None before the first."""
        begun = [k for k, one in enumerate(self.week.rounds) if one.due_s <= utc_s]
        return begun[-1] if begun else None


def left_by(week: Week, plant: Plant, panel: Panel, cell: Path, runs: Path) -> Left:
    """Collect what the checks need."""
    history = plant.history
    found = tuple(row.reading for row in history.reader().all(history.ask()))
    changes = tuple(plant.alarm_changes(0))
    return Left(week=week, plant=plant, panel=panel, cell=cell, runs=runs, readings=found, changes=changes)


def checks_of(left: Left) -> Iterator[Check]:
    """Yield all checks of a week."""
    for part in (_rounds, _readings, _alarms, _review, _condition, _files):
        yield from part(left)


def _rounds(left: Left) -> Iterator[Check]:
    runs = left.plant.rounds.runs(ROUND["name"], limit=10_000)[::-1]
    wanted = [one.due_s for one in left.week.rounds]
    yield Check(
        says="every round took place once, at its time",
        holds=[run.due_s for run in runs] == wanted and len(set(wanted)) == len(wanted),
        saw=f"{len(runs)} runs, {len(wanted)} times",
    )
    failed = [run.why or str(run.state) for run in runs if run.state is not RunState.SUCCEEDED]
    yield Check(says="every round succeeded", holds=not failed, saw=", ".join(failed) or f"{len(runs)} succeeded")
    late = [(run.begun_s or 0.0) - run.due_s for run in runs]
    yield Check(
        says="no round began before its time, or a minute after it",
        holds=all(0.0 <= each <= 60.0 for each in late),
        saw=f"at most {max(late, default=0.0):.1f} s after it",
    )


def _readings(left: Left) -> Iterator[Check]:
    missing = [
        f"{name} in round {k + 1}"
        for k, one in enumerate(left.week.rounds)
        for name in READ
        if not left.of_mission(one.mission, name)
    ]
    yield Check(
        says="the history has every object of every round",
        holds=not missing,
        saw=", ".join(missing[:3]) or f"{len(left.readings)} readings",
    )
    wrong = [
        f"{reading.object} in round {k + 1} shows {reading.text or reading.state or reading.value}"
        for k, one in enumerate(left.week.rounds)
        for name in READ
        for reading in left.of_mission(one.mission, name)
        if reading.is_sure and not _is_right(left.panel, reading, one.truth[name])
    ]
    yield Check(
        says="no sure reading is wrong by the simulator's truth", holds=not wrong, saw=", ".join(wrong) or "none is"
    )
    times = [reading.utc_s for reading in left.readings]
    yield Check(
        says="the readings are in the order of the calendar",
        holds=all(a <= b for a, b in pairwise(times))
        and all(left.week.since_s <= t <= left.week.until_s for t in times),
        saw=f"{len(times)} times",
    )
    trend = left.plant.history.reader().trend(left.plant.history.ask(object=PRESSURE), buckets=SPANS)
    greatest = max((bucket.maximum for bucket in trend if bucket.maximum is not None), default=0.0)
    true = max(one.truth[PRESSURE] for one in left.week.rounds)
    yield Check(
        says="the trend of the pressure has its true maximum",
        holds=abs(greatest - true) <= NEAR_BAR,
        saw=f"{greatest:.2f} bar, truly {true:.2f} bar",
    )


def _is_right(panel: Panel, reading: StoredReading, true: float) -> bool:
    spec = panel.object(reading.object)
    truth = Shown(value=true, state=None, text=None)
    if spec.states_shown:
        truth = Shown(value=None, state="on" if true >= 0.5 else "off", text=None)
    elif reading.text is not None:
        return reading.text.strip() == f"{true:.1f}"
    return spec.is_right(Shown(value=reading.value, state=reading.state, text=reading.text), truth)


def _alarms(left: Left) -> Iterator[Check]:
    alarm = f"{PRESSURE}.high"
    yield from _raised(left, alarm, "the pressure is above its limit", _above(left, HIGH_BAR))
    newest = left.plant.alarms.get(alarm)
    yield Check(
        says="that alarm has returned after the valve was closed, and waits to be acknowledged",
        holds=newest.state is State.RETURNED and not newest.is_active,
        saw=f"it is {newest.state}",
    )
    dark = [k for k, one in enumerate(left.week.rounds) if one.share >= DARK_AT]
    yield from _raised(left, f"{LAMP}.state", "the lamp is out", (dark[:1], dark[:1]))
    now = left.plant.alarms.get(f"{LAMP}.state")
    yield Check(
        says="that alarm holds at the end, unacknowledged", holds=now.state is State.UNACKNOWLEDGED, saw=str(now.state)
    )
    others = {str(one["id"]) for one in left.changes} - {alarm, f"{LAMP}.state"}
    yield Check(says="no other alarm was raised", holds=not others, saw=", ".join(sorted(others)) or "none")


def _above(left: Left, limit: float) -> tuple[list[int], list[int]]:
    """Return the first round in which the pressure may be read above a limit, and the one in which it must be at the latest."""
    may = _first(left.week.rounds, lambda one: one.truth[PRESSURE] > limit - NEAR_BAR)
    must = _first(left.week.rounds, lambda one: one.truth[PRESSURE] > limit + NEAR_BAR)
    return may, must or [len(left.week.rounds) - 1]


def _first(rounds: Iterable[Lived], holds: Callable[[Lived], bool]) -> list[int]:
    return [k for k, one in enumerate(rounds) if holds(one)][:1]


def _raised(left: Left, alarm: str, why: str, when: tuple[list[int], list[int]]) -> Iterator[Check]:
    may, must = when
    risen = [left.round_of(float(str(one["raised_s"]))) for one in left.rises(alarm)]
    yield Check(
        says=f"the alarm {alarm} was raised once, in the round in which {why}",
        holds=len(risen) == 1 and risen[0] is not None and bool(may) and may[0] <= risen[0] <= must[0],
        saw="never" if not risen else ", ".join(f"in round {k + 1}" for k in risen if k is not None),
    )


def _review(left: Left) -> Iterator[Check]:
    _, rows = left.plant.review.waiting(limit=1000)
    waiting = [row.reading for row in rows]
    number = left.week.story.unreadable_round
    mission = left.week.rounds[number].mission
    refused = [one for one in waiting if one.object == FLOW and one.mission == mission and not one.is_valid]
    yield Check(
        says="the flow meter's needle off its scale was refused, and waits for a person",
        holds=len(refused) == 1,
        saw=refused[0].cause if refused else "it does not wait",
    )
    others = [f"{one.object}: {one.doubt}" for one in waiting if one not in refused]
    yield Check(says="nothing else waits", holds=not others, saw="; ".join(others) or "nothing")
    yield Check(
        says="its picture is kept",
        holds=bool(refused) and left.plant.history.crops.path(refused[0].crop or "") is not None,
        saw="it is" if refused and refused[0].crop else "there is none",
    )


def _condition(left: Left) -> Iterator[Check]:
    worked = [k for k, one in enumerate(left.week.rounds) if one.has_relieved]
    may, must = _above(left, TOO_HIGH_BAR)
    yield Check(
        says=f"the valve was closed once, in the round in which the pressure was above {TOO_HIGH_BAR:g} bar",
        holds=len(worked) == 1 and bool(may) and may[0] <= worked[0] <= must[0],
        saw=", ".join(f"in round {k + 1}" for k in worked) or "never",
    )
    touched = [k for k, one in enumerate(left.week.rounds) if RELIEVE in one.steps and k not in worked]
    yield Check(
        says="no other round touched anything",
        holds=not touched,
        saw=", ".join(f"round {k + 1} tried" for k in touched) or "none did",
    )
    shown = [one for one in left.readings if one.object == VALVE and one.mission]
    state = shown[-1].state if shown else None
    yield Check(says="the read-back says that the valve is closed", holds=state == "closed", saw=str(state))


def _files(left: Left) -> Iterator[Check]:
    lacking = [one.mission for one in left.week.rounds if not (left.runs / one.mission / "report.html").is_file()]
    yield Check(
        says="every round has left a report", holds=not lacking, saw=", ".join(lacking) or f"{len(left.week.rounds)}"
    )
    others = [one.mission for one in left.week.rounds if not 0.0 <= _begun_s(one.mission) - one.due_s <= LATEST_S]
    yield Check(
        says="every report has the time of its round",
        holds=not others,
        saw=", ".join(others[:3]) or f"{len(left.week.rounds)}",
    )
    panel = load_cell(left.cell).panel
    same = [
        name
        for name in LIMITS
        if panel.object(name).limits == left.panel.object(name).limits and _is_watched(panel, name)
    ]
    yield Check(
        says="the limits stand in the week's own panel file", holds=len(same) == len(LIMITS), saw=", ".join(same)
    )


def _begun_s(mission: str) -> float:
    """Return when a mission began by its name, seconds since 1970; 0 for a name that is none."""
    try:
        return float(timegm(time.strptime(mission.partition("-")[0], "%Y%m%dT%H%M%S")))
    except ValueError:
        return 0.0


def _is_watched(panel: Panel, name: str) -> bool:
    return panel.object(name).limits is not None or panel.object(name).normal is not None
