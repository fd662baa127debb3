"""Rounds over a month with both clock changes, restarts and real kill -9 of any process. See `benchmarks.plant`.

The service is a process of its own with cell, stop process, world and gateway, on a calendar that this process sets; each mission
takes a moment. Every run that was due must have taken place once, within its window.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomlkit

from hal.atomic_write import write_atomically
from hal.config import load_cell
from hal.errors import CellError
from hal.plant import RoundSection
from service.calendar import Calendar, by_calendar
from service.chaos.family import Process, family_of
from service.chaos.plant import Plant
from service.commissioning.new_cell import copy_cell
from service.operations import OPERATIONS, Operation, OperationContext
from service.processes.client_host import GATEWAY
from service.rounds.book import RoundBook, Run, RunState
from service.rounds.schedule import times_between
from service.schema.mission_request import MissionRequest
from service.schema.mission_results import MissionResult
from service.serve import Options, Panelwright

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "cells/bench.toml"
START_S = datetime(
    2026, 10, 1, 0, 30, tzinfo=UTC
).timestamp()  # Sydney's clocks change on the 4th, Vienna's on the 25th
DAY_S, WINDOW_S = 86_400.0, 3000.0
MISSION_S = 0.3  # on the wall
READY_S, SETTLE_S, POLL_S = 180.0, 120.0, 0.05
MOST_DOWN_S = 600.0  # of the calendar, while the service is down
ROLES = ("service", "cell", "stop", "world", "gateway")
ROUNDS = tuple(
    RoundSection(name=name, cron=cron, zone=zone, window_s=WINDOW_S)
    for name, cron, zone in (
        ("vienna", "30 2 * * *", "Europe/Vienna"),
        ("sydney", "15 2 * * *", "Australia/Sydney"),
        ("often", "0 */6 * * *", "Europe/Vienna"),
    )
)


class SharedCalendar(Calendar):
    """A calendar that another process sets by a file: a time, and the monotonic time from which it goes on."""

    def __init__(self, path: Path) -> None:
        super().__init__(START_S)
        self._path = path

    def now_s(self) -> float:
        """Return the time, seconds since 1970."""
        set_s, at_s = map(float, self._path.read_text(encoding="ascii").split())
        return set_s + time.monotonic() - at_s

    @staticmethod
    def write(path: Path, now_s: float) -> None:
        """Let the calendar go on from a time."""
        write_atomically(path, f"{now_s!r} {time.monotonic()!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Month:
    """What became of the runs.

    Attributes:
        due: how many were due; `missed` of them did not take place, `doubled` took place more than once, and `shifted` began
            before their time or after their window.
        restarts, kills: of the service, and of any process by its role.
        interrupted: runs in whose middle a process was killed.
    """

    due: int
    missed: int
    doubled: int
    shifted: int
    restarts: int
    kills: Mapping[str, int]
    interrupted: int

    @property
    def holds(self) -> bool:
        """Whether no run was missed, doubled or shifted."""
        return self.missed == self.doubled == self.shifted == 0


@dataclass(slots=True, kw_only=True)
class Month30:
    """The month as it is lived: the service, its calendar, and what is done to it."""

    folder: Path
    rng: random.Random
    plant: Plant
    kills: Counter[str] = field(default_factory=Counter)
    restarts: int = 0

    @property
    def calendar(self) -> Path:
        """The file of the calendar."""
        return self.folder / "calendar"

    def start(self) -> None:
        """Start the service and wait for it."""
        self.plant.start()
        self.plant.await_ready(READY_S)
        self.plant.roles()

    def leap_to(self, then_s: float) -> None:
        """Set the calendar to a later time; one that is later already stays."""
        SharedCalendar.write(self.calendar, max(then_s, SharedCalendar(self.calendar).now_s()))

    def restart(self, due_s: float) -> None:
        """End the service in an orderly way, let a run become due meanwhile, and start it again."""
        self.plant.end(signal.SIGTERM)
        self.leap_to(due_s + self.rng.uniform(0.0, MOST_DOWN_S))
        self.start()
        self.restarts += 1

    def kill(self, due_s: float) -> None:
        """Let a run become due, and kill one of the processes at any moment of it."""
        self.leap_to(due_s)
        threading.Event().wait(self.rng.uniform(0.0, 2.0))
        known = self.plant.roles() | _gateway_of(self.plant.pid)
        present = [role for role in ROLES if role in known]
        role = self.rng.choice(present)
        os.kill(known[role].pid, signal.SIGKILL)
        self.kills[role] += 1
        if role == "service":
            self.plant.end(signal.SIGKILL)
            self.start()

    def settle(self, due_s: float) -> None:
        """Wait until nothing that was due waits or runs; a latched stop is reset as a person would."""
        end_s = time.monotonic() + SETTLE_S
        while time.monotonic() < end_s:
            try:
                client = self.plant.client(5.0)
                stop = client.get("/v1/stop")
                if stop["is_latched"] and self.plant.is_ready():
                    client.post("/v1/stop/reset", {"seen_count": stop["count"]})
                if all(_is_settled(one, due_s) for one in client.get("/v1/rounds")["rounds"]):
                    return
            except CellError:
                if not self.plant.is_alive():
                    self.start()
            threading.Event().wait(POLL_S)
        raise AssertionError(f"a run has not ended; the service printed last: {self.plant.lines[-5:]}")


def _gateway_of(pid: int) -> dict[str, Process]:
    """Return the gateway of a service, if it has one now."""
    for one, process in family_of(pid).items():
        try:
            words = Path(f"/proc/{one}/cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if GATEWAY.encode() in words:
            return {"gateway": process}
    return {}


def _is_settled(one: dict[str, Any], due_s: float) -> bool:
    newest = one["newest"]
    is_over = newest is None or newest["state"] not in ("beginning", "running")
    return one["waiting_s"] is None and is_over and one["next_s"] > due_s


def month(
    seed: int, *, days: float = 30.0, restarts: int = 40, kills: int = 20, tell: Callable[[str], None] = print
) -> Month:
    """Live through the month; `tell` gets a line now and then."""
    rng, end_s = random.Random(seed), START_S + days * DAY_S
    dues_s = sorted({due_s for one in ROUNDS for due_s in times_between(one.cron, one.zone, START_S, end_s)})
    if restarts + kills > len(dues_s):
        raise ValueError(f"{days:g} days have {len(dues_s)} times only")
    done_at = rng.sample(range(len(dues_s)), restarts + kills)
    deeds = dict.fromkeys(done_at[:restarts], "restart") | dict.fromkeys(done_at[restarts:], "kill")
    with tempfile.TemporaryDirectory(prefix="panelwright-month-") as name:
        folder = Path(name)
        cell = _write_cell(folder)
        plant = Plant(command=_command(cell, folder), runs=folder / "runs")
        lived = Month30(folder=folder, rng=rng, plant=plant)
        SharedCalendar.write(lived.calendar, START_S)
        try:
            lived.start()
            for number, due_s in enumerate(dues_s):
                getattr(lived, deeds.get(number, "leap_to"))(due_s)
                lived.settle(due_s)
                if number % 20 == 19:
                    tell(f"{number + 1} of {len(dues_s)} times, {lived.restarts} restarts, kills {dict(lived.kills)}")
            now_s = SharedCalendar(lived.calendar).now_s()
            plant.end(signal.SIGTERM)
        finally:
            plant.sweep()
        return _judged(folder, now_s, lived)


def _judged(folder: Path, now_s: float, lived: Month30) -> Month:
    """Compare the record of the rounds, and the missions that really began, with the times of the expressions."""
    began = [line.split() for line in (folder / "began").read_text(encoding="ascii").splitlines()]
    book = RoundBook(folder / "runs/.service/rounds/bench.sqlite")
    due = missed = doubled = shifted = interrupted = 0
    for one in ROUNDS:
        runs: dict[float, list[Run]] = {}
        for run in book.runs(one.name, limit=10_000):
            runs.setdefault(run.due_s, []).append(run)
        wanted = times_between(one.cron, one.zone, START_S, now_s)
        due += len(wanted)
        moments = [float(at_s) for name, at_s in began if name == one.name]
        times = Counter(max((each for each in wanted if each <= at_s), default=0.0) for at_s in moments)
        for due_s in wanted:
            found = runs.pop(due_s, [])
            missed += not found or found[0].state is RunState.MISSED
            doubled += len(found) > 1 or times[due_s] > 1
            late_s = (found[0].begun_s or due_s) - due_s if found else 0.0
            shifted += not 0.0 <= late_s <= WINDOW_S
            interrupted += bool(found) and found[0].state is RunState.INTERRUPTED
        shifted += len(runs) + times[0.0]  # runs at times that nobody asked for
    book.close()
    return Month(
        due=due, missed=missed, doubled=doubled, shifted=shifted, restarts=lived.restarts, kills=dict(lived.kills),
        interrupted=interrupted,
    )  # fmt: skip


def _write_cell(folder: Path) -> Path:
    """Copy the bench cell with the rounds, and an outlet so that there is a gateway."""
    copied = copy_cell(BENCH, folder / "plant")
    document = tomlkit.parse(copied.cell.read_text(encoding="utf-8"))
    rounds = tomlkit.aot()
    for one in ROUNDS:
        rounds.append(tomlkit.item(one.model_dump(exclude_defaults=True)))
    document["rounds"] = rounds
    document["outlets"] = {"prometheus": {"port": 19_464}}
    copied.cell.write_text(tomlkit.dumps(document), encoding="utf-8")
    return copied.cell


def _command(cell: Path, folder: Path) -> Callable[[int, int, Path], Sequence[str]]:
    def command(port: int, stop_port: int, runs: Path) -> Sequence[str]:
        given = (cell, folder, port, stop_port, runs)
        return [sys.executable, "-m", "benchmarks.plant_rounds", *map(str, given)]

    return command


def serve(cell: Path, folder: Path, port: int, stop_port: int, runs: Path) -> None:
    """Serve the cell on the shared calendar; a mission notes in a file that it began, and takes a moment."""
    calendar = SharedCalendar(folder / "calendar")

    def run(context: OperationContext, _request: MissionRequest) -> MissionResult:
        with (folder / "began").open("a", encoding="ascii") as file:
            file.write(f"{context.observer.asked_by.removeprefix('round ')} {calendar.now_s()!r}\n")
            file.flush()
            os.fsync(file.fileno())
        threading.Event().wait(MISSION_S)
        context.task.check_cancelled()
        return MissionResult(
            mission="", succeeded=True, report=None, actions=[], fused=None, depths=[], cell_s=0.0, wall_s=MISSION_S
        )

    mission = Operation(
        name="missions", request_model=MissionRequest, result_model=MissionResult, run=run, summary="A moment"
    )
    with by_calendar(calendar):
        options = Options(port=port, stop_port=stop_port, runs_dir=runs, warm=False)
        panelwright = Panelwright(load_cell(cell), options, operations={**OPERATIONS, "missions": mission})
    panelwright.run()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
