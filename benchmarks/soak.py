"""Memory and descriptors of a service for long: `python -m benchmarks.soak [--minutes 30] [--settle 5] [--chaos SEED]`.

Under a mix: missions, readings, pictures, listeners of the stream that come and go, stops with resets, and broken requests. Or
under chaos, which breaks something in each mission; `--same-service` leaves out the two faults that end the service, because a
service that lives for minutes only shows no slow growth. Memory and open descriptors are sampled at rest, when no task runs and
nobody asks: after each mission of the mix, and between the rounds of the chaos. What a request holds while it is answered is no
growth. The memory is what a process has allocated and touched (resident and anonymous). It leaves out the pages of library
files, and counts a page that a process shares with the one that forked it. Otherwise a figure would change because another
process begins to use the same library, or writes to a page that both had.

After the first minutes, in which libraries and kernels load, the memory may grow by 5 MB and the descriptors not at all. A process
that has just begun has loaded less than one that has worked, and chaos replaces processes all the time. So like is compared with
like: the median of all samples after the same number of rounds is subtracted from each. Prints a table, with what has grown that
way, the breaches of the chaos and the pass line.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks.kills import chaos_on
from hal.arrays import Array
from hal.errors import CellError
from service.chaos.family import PROC, roles_of
from service.chaos.faults import FAULTS
from service.chaos.options import ChaosOptions
from service.chaos.plant import Plant, serve_command
from service.client import FINAL, ApiError

CELL = Path(__file__).resolve().parents[1] / "cells/bench.toml"
START_S = 400.0
WORK_EVERY_S = 0.2
STOP_EVERY_S = 180.0  # so that missions also come to their ends and write their reports
PASS_MB = 5.0
WINDOW = 0.2  # of the samples: the medians of the first and the last ones are compared
LIKE_AFTER = 6  # rounds, after which a process loads no more
REST_S = 1.5  # after a round, until its last requests are answered
ROLES = ("service", "cell", "stop", "world")


class Sample(NamedTuple):
    """A look at a process.

    Attributes:
        worked: number of rounds since the process began; 0 under the mix.
        memory_mb: what it has allocated and touched.
        descriptors: number of open ones.
    """

    worked: int
    memory_mb: float
    descriptors: float


Samples = dict[str, list[Sample]]
"""The looks at the process of each role, in the order of time."""
Work = Callable[[Plant], None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--settle", type=float, default=5.0, help="minutes that do not count")
    parser.add_argument("--chaos", type=int, help="break things with this seed instead of the mix")
    parser.add_argument("--same-service", action="store_true", help="no chaos that ends the service")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        plant = Plant(command=serve_command(CELL, None), runs=Path(folder) / "runs")
        work = _mixed if given.chaos is None else partial(_broken, given.chaos, given.same_service)
        samples, breaches = work(plant, given.minutes, given.settle)
        tracebacks = sum("Traceback" in line for line in plant.lines)
    print("| process | MB at first | at last | grown | descriptors at first | at last | grown |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    grown_mb, more = 0.0, 0.0
    for role, rows in samples.items():
        part = max(1, round(WINDOW * len(rows)))
        first, last = (np.median([row[1:] for row in some], axis=0) for some in (rows[:part], rows[-part:]))
        like = _without_levels(rows)
        mb, descriptors = np.median(like[-part:], axis=0) - np.median(like[:part], axis=0)
        grown_mb, more = grown_mb + max(0.0, mb), more + max(0.0, descriptors)
        print(
            f"| {role} | {first[0]:.1f} | {last[0]:.1f} | {mb:+.1f} | {first[1]:.0f} | {last[1]:.0f} | {descriptors:+.1f} |"
        )
    print(
        f"memory {grown_mb:+.1f} MB after {given.settle:.0f} of {given.minutes:.0f} minutes (pass: +{PASS_MB:.0f}), descriptors "
        f"{more:+.0f} (pass: 0), tracebacks {tracebacks} (pass: 0), breaches {breaches} (pass: 0), load {os.getloadavg()[0]:.0f}"
    )
    return int(grown_mb > PASS_MB or more > 0 or tracebacks + breaches > 0)


def _mixed(plant: Plant, minutes: float, settle: float) -> tuple[Samples, int]:
    """Return the samples under the mix, in which nothing is judged."""
    rows: Samples = {role: [] for role in ROLES}
    mix = _Mix(plant)
    try:
        plant.start()
        plant.await_ready(START_S)
        for work, every_s in BESIDES:
            threading.Thread(target=mix.repeat, args=(work, every_s), daemon=True).start()
        begun_s = time.monotonic()
        while (passed_s := time.monotonic() - begun_s) < 60.0 * minutes:
            mix.do(_mission)
            with mix.at_rest():
                time.sleep(REST_S)
                for role, process in roles_of(plant.pid).items() if passed_s >= 60.0 * settle else ():
                    _add(rows[role], process.pid, worked=0)
    finally:
        mix.end.set()
        plant.end()
        plant.sweep()
    print(", ".join(f"{count} x {name[1:]}" for name, count in mix.done.items()))
    return rows, 0


class _Mix:
    """Works beside one another on one service, which can be made to rest.

    Attributes:
        end: set when no more work may begin.
        done: how often each work was done, by its name.
    """

    def __init__(self, plant: Plant) -> None:
        self.end = threading.Event()
        self.done: Counter[str] = Counter()
        self._plant = plant
        self._changed = threading.Condition()
        self._working = 0
        self._rests = False

    def repeat(self, work: Work, every_s: float) -> None:
        """Do a work again and again until the end, and not while the service rests."""
        while not self.end.wait(every_s):
            with self._changed:
                self._changed.wait_for(lambda: not self._rests)
                self._working += 1
            try:
                self.do(work)
            finally:
                with self._changed:
                    self._working -= 1
                    self._changed.notify_all()

    def do(self, work: Work) -> None:
        """Do a work once; it counts when it succeeds."""
        with suppress(CellError, OSError, WebSocketException):
            work(self._plant)
            self.done[work.__name__] += 1

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        """Wait until no repeated work is under way, and let none begin in the context."""
        with self._changed:
            self._rests = True
            self._changed.wait_for(lambda: self._working == 0)
        try:
            yield
        finally:
            with self._changed:
                self._rests = False
                self._changed.notify_all()


def _broken(seed: int, same_service: bool, plant: Plant, minutes: float, settle: float) -> tuple[Samples, int]:
    """Return the samples under chaos, and the number of its breaches."""
    faults = tuple(fault.name for fault in FAULTS if not (same_service and fault.restarts))
    chaos = chaos_on(plant, CELL, ChaosOptions(seed=seed, minutes=minutes, faults=faults))
    begun_s = time.monotonic()
    rows: Samples = {role: [] for role in ROLES}
    known: dict[str, tuple[int, int]] = {}  # process id of each role, and the rounds since it began
    rounds = []
    for one in chaos.rounds(lambda one: print(f"  {one}", file=sys.stderr, flush=True)):
        rounds.append(one)
        time.sleep(REST_S)
        for role, process in roles_of(plant.pid).items():
            pid, worked = known.get(role, (0, 0))
            known[role] = (process.pid, worked + 1 if pid == process.pid else 0)
            if time.monotonic() - begun_s >= 60.0 * settle:
                _add(rows[role], process.pid, worked=known[role][1])
    breaches = [f"{one.fault}: {breach}" for one in (*rounds, chaos.final) for breach in one.breaches]
    print("\n".join([f"{len(rounds)} rounds in {plant.life} lives of the service", *breaches]))
    return rows, len(breaches)


def _add(rows: list[Sample], pid: int, *, worked: int) -> None:
    with suppress(psutil.Error, OSError, StopIteration):  # it ends at this moment
        one = psutil.Process(pid)
        rows.append(Sample(worked, _allocated_mb(pid), float(one.num_fds())))


def _allocated_mb(pid: int) -> float:
    status = (PROC / str(pid) / "status").read_text(encoding="ascii", errors="replace")
    return next(int(line.split()[1]) * 1024e-6 for line in status.splitlines() if line.startswith("RssAnon:"))


def _without_levels(rows: Sequence[Sample]) -> Array:
    """Return memory and descriptors (N, 2) without the medians of the samples after the same number of rounds."""
    worked = np.minimum([row.worked for row in rows], LIKE_AFTER)
    values = np.array([row[1:] for row in rows])
    for count in np.unique(worked):
        values[worked == count] -= np.median(values[worked == count], axis=0)
    return values


def _mission(plant: Plant) -> None:
    task = plant.client().post("/v1/missions", {"file": "demo"})
    while plant.client().get(f"/v1/tasks/{task['id']}")["state"] not in FINAL:
        time.sleep(0.5)


def _reading(plant: Plant) -> None:
    plant.client().fetch("GET", "/v1/devices/wrist_camera/reading?format=png")
    plant.client().get("/v1/devices")


def _listener(plant: Plant) -> None:
    with connect(f"ws://127.0.0.1:{plant.port}/v1/stream", proxy=None, open_timeout=20) as stream:
        for _ in range(20):
            stream.recv(timeout=10.0)


def _stop(plant: Plant) -> None:
    count = plant.stop_client().post("/v1/stop")["count"]
    time.sleep(1.0)
    plant.client().post("/v1/stop/reset", {"seen_count": count})


def _nonsense(plant: Plant) -> None:
    with suppress(ApiError):  # the refusal is what is wanted; a missing answer is another error, and is not counted
        plant.client().post("/v1/missions", {"file": 5})


BESIDES: tuple[tuple[Work, float], ...] = (
    (_reading, WORK_EVERY_S),
    (_listener, WORK_EVERY_S),
    (_stop, STOP_EVERY_S),
    (_nonsense, WORK_EVERY_S),
)
"""What is done beside the missions, and the pause before each."""


if __name__ == "__main__":
    raise SystemExit(main())
