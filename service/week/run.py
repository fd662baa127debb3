"""Runs the simulated week on a service: sets the calendar to each round in turn, and lets the service do the rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import DeviceFault, Unsupported
from hal.simulated import ShowsValues
from service.calendar import Calendar, by_calendar
from service.rounds.book import OPEN, Run
from service.rounds.schedule import times_between
from service.serve import Options, Panelwright
from service.week.files import ROUND, VALVE
from service.week.story import Story

DAY_S = 86_400.0
AFTER_S = 600.0  # from the last round to the end of the week
ROUND_PATIENCE_S = 300.0
POLL_S = 0.05
RELIEVE = "decide/relieve"


@dataclass(frozen=True, slots=True, kw_only=True)
class Lived:
    """One round as it went: its time and share of the week, what the instruments truly showed, and its run and steps."""

    due_s: float
    share: float
    truth: dict[str, float]
    run: Run
    steps: dict[str, str] = field(default_factory=dict)
    mission: str = ""

    @property
    def has_relieved(self) -> bool:
        """Whether the mission closed the valve in this round."""
        return self.steps.get(RELIEVE) == "done"


@dataclass(frozen=True, slots=True, kw_only=True)
class Week:
    """The whole week: from when to when (seconds since 1970), its story, and its rounds."""

    since_s: float
    until_s: float
    story: Story
    rounds: tuple[Lived, ...]


def times_of(days: float, now_s: float) -> tuple[float, float, list[float]]:
    """Return beginning and end of so many days that end shortly before now, and the times of their rounds."""
    newest_s = times_between(ROUND["cron"], ROUND["zone"], now_s - DAY_S, now_s - AFTER_S)[-1]
    until_s = newest_s + AFTER_S
    since_s = until_s - days * DAY_S
    return since_s, until_s, times_between(ROUND["cron"], ROUND["zone"], since_s, until_s)


def serve_week(cell: Path, runs: Path, since_s: float, *, inline: bool, port: int) -> tuple[Panelwright, Calendar]:
    """Return a service on the plant of the week, not yet started, and the calendar that it goes by."""
    calendar = Calendar(since_s)
    with by_calendar(calendar):
        return Panelwright(load_cell(cell), Options(port=port, runs_dir=runs, inline=inline)), calendar


def live_week(
    panelwright: Panelwright,
    calendar: Calendar,
    *,
    days: float,
    now_s: float,
    tell: Callable[[int, int, Lived], None] = lambda _number, _count, _lived: None,
) -> Week:
    """Run all rounds of the week on a started service.

    Args:
        days, now_s: as for `times_of`, with which the calendar was made.
        tell: called after each round with its number from 1, the number of all, and how it went.

    Raises:
        CellError: the cell failed.
    """
    since_s, until_s, dues_s = times_of(days, now_s)
    story, plant = Story(days=days, rounds=len(dues_s)), _process_behind(panelwright)
    _open_valve(panelwright)
    lived: list[Lived] = []
    for number, due_s in enumerate(dues_s):
        share = (due_s - since_s) / (until_s - since_s)
        truth = story.values(number, share)
        for name, value in truth.items():
            plant.show(name, value)
        calendar.leap_to(due_s)
        one = _round_at(panelwright, due_s, share, truth)
        if one.has_relieved:
            story.relieved_at = share
        lived.append(one)
        tell(number + 1, len(dues_s), one)
    calendar.leap_to(max(until_s, calendar.now_s()))
    panelwright.service.plant.alarms.tick()
    return Week(since_s=since_s, until_s=until_s, story=story, rounds=tuple(lived))


def _process_behind(panelwright: Panelwright) -> ShowsValues:
    """Return what lets the simulated instruments show other values."""
    for arm in panelwright.service.supervisor.connection.devices_of(DeviceKind.ARM).values():
        if hasattr(arm, "show"):
            found: ShowsValues = arm
            return found
    raise Unsupported("the panel of this cell is not simulated", hint="use a cell with sim:arm")


def _open_valve(panelwright: Panelwright) -> None:
    """Begin with an open valve, whatever the seed has drawn."""
    client = panelwright.client(timeout_s=120.0)
    stop = client.get("/v1/stop")
    if stop["is_latched"]:  # as in `demo`, whoever runs it states that the cell is clear
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})
    task = client.post("/v1/manipulate", {"object": VALVE, "state": "open"})
    for _ in client.events(task["id"]):  # a task that nobody follows is cancelled, however busy the machine is
        pass
    done = panelwright.service.tasks.get(task["id"])
    done.wait(ROUND_PATIENCE_S)
    if done.problem is not None:
        raise DeviceFault(str(done.problem["detail"]), hint=str(done.problem["hint"]), device="arm")


def _round_at(panelwright: Panelwright, due_s: float, share: float, truth: dict[str, float]) -> Lived:
    """Let the run that is due at this moment take place, and return how it went."""
    keeper, end_s = panelwright.service.plant.rounds, time.monotonic() + ROUND_PATIENCE_S
    while True:
        keeper.tick()
        found = next(iter(keeper.runs(ROUND["name"], limit=1)), None)
        if found is not None and found.due_s == due_s and found.state not in OPEN:
            break
        if time.monotonic() > end_s:
            waits = next(iter(keeper.prospects())).waits_for
            raise DeviceFault(
                f"the round has not ended within {ROUND_PATIENCE_S:.0f} s: {waits or 'its mission goes on'}",
                hint="see the service's log",
                device="cell",
            )
        _wait_for(panelwright, found, due_s)
    result = None if found.task is None else panelwright.service.tasks.get(found.task).result
    told: dict[str, Any] = result if isinstance(result, dict) else {}
    steps = {str(step["path"]): str(step["outcome"]) for step in told.get("steps", [])}
    return Lived(due_s=due_s, share=share, truth=truth, run=found, steps=steps, mission=str(told.get("mission", "")))


def _wait_for(panelwright: Panelwright, run: Run | None, due_s: float) -> None:
    """Wait until the task of a run has ended, or, before there is one, a little."""
    if run is None or run.due_s != due_s or run.task is None:
        threading.Event().wait(POLL_S)
        return
    panelwright.service.tasks.get(run.task).wait(ROUND_PATIENCE_S)
