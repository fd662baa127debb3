"""Fault matrix: device x fault x every 3rd and 20th frame; many cells run at the same time, as they mostly wait."""

from __future__ import annotations

import multiprocessing
import sys
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

from benchmarks.drivers.bench import Bench
from benchmarks.drivers.benches import BENCHES, bench, running
from benchmarks.drivers.report import CLOCK, READ_S, deadline, line
from drivers.emulators.faults import WireFault
from hal.errors import CellError
from hal.readings import Quality, Stamped

RATES = (3, 20)  # a fault in every 3rd and every 20th frame
MIXED = "mixed"  # a random one of the device's faults each time
SLACK_S = 0.05
BEAT_S = 0.005
STALL_S = 0.001  # if the probe wakes later than this, the process was not running and no driver could answer
REST_S = 0.005
PROCESSES = 2
AT_ONCE = 7  # cells per process


@dataclass(slots=True)
class Cell:
    """Counts of one cell of the matrix; `stalled` are late calls during which the process was not running."""

    good: int = 0
    errors: int = 0
    wrong: int = 0
    stale: int = 0
    late_calls: int = 0
    stalled: int = 0
    untyped: int = 0

    def add(self, other: Cell) -> None:
        """Add the counts of another cell."""
        for field in fields(Cell):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))


class StallProbe:
    """Thread that only sleeps and wakes; if it is late, the process stood still, as no blocking driver can delay it."""

    def __init__(self) -> None:
        self._stalls: list[tuple[float, float]] = []
        self._beat_s = time.monotonic()
        self._beaten = threading.Condition()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(BEAT_S):
            with self._beaten:
                now_s, before_s = time.monotonic(), self._beat_s
                if now_s - before_s > BEAT_S + STALL_S:
                    self._stalls.append((before_s + BEAT_S, now_s))
                self._beat_s = now_s
                self._beaten.notify_all()

    def stalled_s(self, start_s: float, end_s: float) -> float:
        """Return how long this process stood still in the interval; waits until the probe has reached its end."""
        with self._beaten:
            self._beaten.wait_for(lambda: self._beat_s >= end_s, timeout=1.0)
            return sum(max(0.0, min(end_s, b) - max(start_s, a)) for a, b in self._stalls)

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join()


Key = tuple[str, str, int]  # name of the test setup, fault, every how manyth frame


def part_faults(seconds: float) -> None:
    """Run all cells; print one line per device and fault rate, and each cell with defects or without a good sample."""
    started_s = time.monotonic()
    cells = matrix(BENCHES, seconds)
    for item in BENCHES:
        for every in RATES:
            _row(item, every, {str(fault): cells[item.name, str(fault), every] for fault in (*item.faults, MIXED)})
    print(f"    {len(cells)} cells of {seconds:.0f} s in {time.monotonic() - started_s:.0f} s of wall time")


def matrix(items: Iterable[Bench], seconds: float) -> dict[Key, Cell]:
    """Run every cell of some test setups; returns the counts by name, fault and rate."""
    keys = [(item.name, str(fault), every) for item in items for every in RATES for fault in (*item.faults, MIXED)]
    order = sorted(keys, key=lambda key: (key[1], key[2], key[0]))  # a batch mixes light and heavy devices
    alone = [key for key in order if bench(key[0]).is_alone]
    order = [key for key in order if key not in alone]
    cells: dict[Key, Cell] = {}
    for processes, batches in (
        (PROCESSES, [order[i : i + AT_ONCE] for i in range(0, len(order), AT_ONCE)]),
        (1, [[key] for key in alone]),
    ):
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
            for batch, found in zip(batches, pool.map(run_batch, batches, [seconds] * len(batches)), strict=True):
                cells.update(zip(batch, found, strict=True))
    return cells


def _row(item: Bench, every: int, cells: dict[str, Cell]) -> None:
    total = Cell()
    for cell in cells.values():
        total.add(cell)
    is_good = total.wrong == total.stale == total.late_calls == total.untyped == 0
    measured = f"{total.wrong} / {total.stale} / {total.late_calls} of {total.good} + {total.errors} err"
    line(f"{item.name}, every {every}: wrong / stale / late", "0 / 0 / 0", measured, is_good)
    for fault, cell in cells.items():
        if cell.wrong or cell.stale or cell.late_calls or cell.untyped or not cell.good:
            print(f"    {fault}: {cell}")
    if total.stalled:
        print(f"    {total.stalled} more calls were late while the machine did not run this process")


def run_batch(batch: list[Key], seconds: float) -> list[Cell]:
    """Run some cells at the same time, in a worker process."""
    sys.setswitchinterval(0.001)
    probe = StallProbe()
    with ThreadPoolExecutor(len(batch)) as pool:
        found = list(pool.map(lambda key: fault_cell(bench(key[0]), key[1], key[2], seconds, probe), batch))
    probe.close()
    return found


def fault_cell(item: Bench, fault: str, every: int, seconds: float, probe: StallProbe) -> Cell:
    """Read over a faulty link for some time; a device that cannot be connected is tried again."""
    cell = Cell()
    mixed = [str(kind) for kind in item.faults if kind is not WireFault.ECHO]  # a line always echoes or never does
    what = {"mixed": mixed} if fault == MIXED else {"fault": str(fault)}
    options = {**what, "every": every, "seed": every, "delay_s": 0.15, "silent_s": 0.15, "away_s": 0.05}
    rest, end_s = threading.Event(), time.monotonic() + seconds
    while time.monotonic() < end_s:
        try:
            with running(item, options) as (device, _, backing):
                reader = Reader(item, device, backing, cell, probe)
                while time.monotonic() < end_s:
                    reader.read()
                    rest.wait(REST_S)
        except CellError:
            cell.errors += 1  # the device reported that it could not be connected
    return cell


class Reader:
    """Reads one device and checks its values."""

    def __init__(self, item: Bench, device: Any, backing: Any, cell: Cell, probe: StallProbe) -> None:
        self._item = item
        self._device = device
        self._backing = backing
        self._cell = cell
        self._probe = probe
        self._last: Stamped[Any] | None = None

    def read(self) -> None:
        """Read once; a new value is checked once, its age every time."""
        started_s = time.monotonic()
        sample: Stamped[Any] | None = None
        try:
            sample = self._item.read(self._device, deadline())
        except CellError:
            self._cell.errors += 1
        except Exception as error:
            self._cell.untyped += 1
            print(f"    untyped: {error!r}")
        ended_s, call_s = time.monotonic(), time.monotonic() - started_s
        self._cell.late_calls += self._is_ours(started_s, ended_s, call_s - READ_S - SLACK_S)
        if sample is None or sample.quality is Quality.INVALID:
            return
        self._cell.good += 1
        age_s = max(0.0, CLOCK.now_s() - sample.host_time_s - (time.monotonic() - ended_s))
        is_old = age_s > self._device.max_age_s + SLACK_S + call_s
        if sample is not self._last:
            self._last = sample
            is_true = self._item.is_true(sample.value, self._backing)
            self._cell.wrong += not is_true
            if is_true and self._item.taken_s is not None:
                taken_s = self._item.taken_s(sample.value, self._backing)
                is_old |= self._is_ours(taken_s, ended_s, ended_s - taken_s - age_s - SLACK_S)
        self._cell.stale += is_old

    def _is_ours(self, start_s: float, end_s: float, over_s: float) -> bool:
        """Return whether the driver itself is late; if the process stood still as long, a stall is counted instead."""
        if over_s <= 0.0:
            return False
        is_stall = self._probe.stalled_s(start_s, end_s) >= over_s
        self._cell.stalled += is_stall
        return not is_stall
