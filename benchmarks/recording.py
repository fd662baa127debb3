"""Records and replays whole missions: `python -m benchmarks.recording [FIRST LAST] [--cell FILE]`.

For each seed a mission runs without a recording, then with one, and the recording is replayed. Prints a table and the
pass lines: the replay gives the same readings (aim: results equal to the last bit), and recording changes no mission.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from hal.config import load_cell
from service.core import Service
from service.operations import OPERATIONS
from service.recording.reader import numbers_of, open_recording
from service.replay.book import Book, replayed_cell
from service.replay.verdict import Verdict, differing, replay_tasks
from service.schema.mission_request import MissionRequest
from service.serve import Options, Panelwright
from service.warm import warm

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission's result, wall time, and the CPU seconds of the cell's process and of the recorder's during it."""

    result: Any
    wall_s: float
    cell_cpu_s: float
    recorder_cpu_s: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=1)
    parser.add_argument("last", type=int, nargs="?", default=5)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    given = parser.parse_args(arguments)
    print(
        "| seed | succeeded | same mission | calls answered | same bits | MB | messages | cell s | wall s | cell CPU s |"
    )
    print(f"|{' --- |' * 10}", flush=True)
    rows = [measure(seed, given.cell) for seed in range(given.first, given.last + 1)]
    verdicts = [verdict for _, _, verdict, _ in rows]
    plain, recorded = [row[0] for row in rows], [row[1] for row in rows]
    wall = np.median([b.wall_s / a.wall_s for a, b in zip(plain, recorded, strict=True)])
    cpu = np.median([b.cell_cpu_s / a.cell_cpu_s for a, b in zip(plain, recorded, strict=True)])
    is_same = all(same for _, _, _, same in rows)
    readings, bits = sum(v.same_readings for v in verdicts), sum(v.same_bits for v in verdicts)
    print(f"same readings: {readings} of {len(rows)} (pass: all); same bits: {bits} of {len(rows)} (aim: all)")
    print(f"recording changes no mission: {'yes' if is_same else 'NO'} (pass: yes)")
    print(f"with recording over without, medians: wall {wall:.2f}, CPU of the cell's process {cpu:.2f}")
    print(f"CPU of the recorder's process, median: {np.median([one.recorder_cpu_s for one in recorded]):.1f} s")
    return 0 if readings == len(rows) and is_same else 1


def measure(seed: int, cell: Path) -> tuple[Mission, Mission, Verdict, bool]:
    """Run one seed three ways and print its row."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mission.mcap"
        plain = fly(seed, cell, Path(folder) / "plain", None)
        recorded = fly(seed, cell, Path(folder) / "recorded", path)
        verdict = replay(path, Path(folder) / "replayed")
        is_same = not differing(plain.result, recorded.result)
        duration_s = open_recording(path).end_s
        print(
            f"| {seed} | {_yes(recorded.result['succeeded'])} | {_yes(is_same)} | {verdict.answered}/{verdict.calls} "
            f"| {_yes(verdict.same_bits)} | {1e-6 * path.stat().st_size:.1f} | {numbers_of(path)[1]} | {duration_s:.1f} "
            f"| {plain.wall_s:.1f}, {recorded.wall_s:.1f} | {plain.cell_cpu_s:.1f}, {recorded.cell_cpu_s:.1f} |",
            flush=True,
        )
        return plain, recorded, verdict, is_same


def fly(seed: int, cell: Path, runs: Path, record: Path | None) -> Mission:
    """Run a mission in a new service, with everything compiled."""
    panelwright = Panelwright(load_cell(cell, seed=seed), Options(port=0, runs_dir=runs, record=record, warm=False))
    panelwright.start()
    try:
        warm()
        processes = panelwright.service.supervisor.processes()
        cell_process = psutil.Process(next(one.pid for one in processes if one.name == "cell"))
        recorders = [p for p in psutil.Process().children() if any("spawn_main" in word for word in p.cmdline())]
        cpu_s = _cpu_s(cell_process), sum(map(_cpu_s, recorders))
        task = panelwright.service.submit("missions", MissionRequest(file="demo"))
        while not task.wait(1.0):
            pass
        spent_s = _cpu_s(cell_process) - cpu_s[0], sum(map(_cpu_s, recorders)) - cpu_s[1]
    finally:
        panelwright.close()
    assert task.result is not None, task.problem
    return Mission(result=task.result, wall_s=task.result["wall_s"], cell_cpu_s=spent_s[0], recorder_cpu_s=spent_s[1])


def replay(path: Path, folder: Path) -> Verdict:
    """Replay a recording and return the verdict on its mission."""
    book = Book(open_recording(path))
    cell = book.recording.unpack(folder / "cell")
    service = Service(cell, OPERATIONS, runs_dir=folder / "runs", inline=True, replay=lambda: replayed_cell(book, cell))
    try:
        service.start()
        (verdict,) = replay_tasks(service, book, begin=lambda _task: None)
    finally:
        service.close()
    return verdict


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _yes(value: bool) -> str:
    return "yes" if value else "NO"


if __name__ == "__main__":
    raise SystemExit(main())
