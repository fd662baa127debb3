"""Measures speed and memory of the whole cell: `python -m benchmarks.cell [SEED ...]`; prints figures and limits.

Everything runs through the real server: processes, HTTP, the mission, the stop port. Times depend on the machine; the
time of one plain loop in the same run shows how busy the machine was.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from hal.config import load_cell
from hal.motion import Hold
from service.client import Client
from service.processes.cell import CellRuntime
from service.serve import Options, Panelwright

ROOT = Path(__file__).resolve().parents[1]
STOPS = 200
FLOOR_LOOPS = 2_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """Measured figure beside its limit; `is_met` is None if there is no limit."""

    what: str
    measured: str
    wanted: str
    is_met: bool | None


def main(arguments: Sequence[str]) -> int:
    """Measure and print; return exit code 1 if a limit is missed."""
    seeds = [int(a) for a in arguments] or [1]
    console = Console()
    lines = [_floor(), real_time_factor()]
    for seed in seeds:
        console.print(f"mission with seed {seed} ...")
        lines += measure_mission(seed)
    table = Table("figure", "measured", "pass line", "", box=None)
    for line in lines:
        mark = "" if line.is_met is None else ("[green]met[/]" if line.is_met else "[red]MISSED[/]")
        table.add_row(line.what, line.measured, line.wanted, mark)
    console.print(table)
    return 1 if any(line.is_met is False for line in lines) else 0


def real_time_factor() -> Line:
    """Measure simulated per wall-clock seconds of the control loop, with every sensor read in each tick."""
    runtime = CellRuntime.start(load_cell(ROOT / "cells/bench.toml"), is_latched=lambda: False)
    try:
        mover = runtime.objects["cell.mover"]
        mover.execute(Hold(name="warm", duration_s=0.5))
        factors = []
        for _ in range(5):
            started_s = time.perf_counter()
            mover.execute(Hold(name="measure", duration_s=2.0))
            factors.append(2.0 / (time.perf_counter() - started_s))
    finally:
        runtime.close()
    factor = float(np.median(factors))
    return Line(
        what="real-time factor, all sensors (median of 5)", measured=f"{factor:.1f}", wanted=">= 4", is_met=factor >= 4
    )


def measure_mission(seed: int) -> list[Line]:
    """Measure the start-up, one mission and the stop port through the real server."""
    with tempfile.TemporaryDirectory() as folder:
        cell = load_cell(ROOT / "cells/bench.toml", seed=seed)
        started_s = time.monotonic()
        panelwright = Panelwright(cell, Options(port=0, runs_dir=Path(folder)))
        panelwright.start()
        ready_s = time.monotonic() - started_s
        try:
            client = Client(url=panelwright.url, timeout_s=120.0)
            clear_stop(client)
            with _Memory() as memory:
                mission = run_to_end(client, "/v1/missions", {"file": "demo"})
            lag_s = float(client.get("/v1/info")["event_loop_lag_p99_s"])
            stops_s = _stops_while_rendering(client, panelwright.stop_url)
        finally:
            panelwright.close()
    return _mission_lines(seed, ready_s, mission, memory, lag_s, stops_s)


def _mission_lines(
    seed: int, ready_s: float, mission: dict[str, Any], memory: _Memory, lag_s: float, stops_s: list[float]
) -> list[Line]:
    result = mission.get("result") or {}
    wall_s, cell_s = float(result.get("wall_s", np.inf)), float(result.get("cell_s", np.inf))
    stop_p99_ms = 1e3 * float(np.quantile(stops_s, 0.99))
    peak_gb = memory.peak_bytes / 1e9
    done = bool(result.get("succeeded"))
    return [
        Line(what=f"seed {seed}: every action confirmed", measured=str(done), wanted="True", is_met=done),
        Line(what="service ready after", measured=f"{ready_s:.1f} s", wanted="<= 5 s", is_met=ready_s <= 5.0),
        Line(what="mission on the wall", measured=f"{wall_s:.1f} s", wanted="<= 60 s", is_met=wall_s <= 60.0),
        Line(what="mission on the cell's clock", measured=f"{cell_s:.1f} s", wanted="<= 60 s", is_met=cell_s <= 60.0),
        Line(
            what="event-loop lag in the mission, p99",
            measured=f"{1e3 * lag_s:.1f} ms",
            wanted="<= 10 ms",
            is_met=lag_s <= 0.010,
        ),
        Line(
            what=f"stop while rendering, p99 of {len(stops_s)}",
            measured=f"{stop_p99_ms:.1f} ms",
            wanted="<= 10 ms",
            is_met=stop_p99_ms <= 10.0,
        ),
        Line(
            what="memory of all processes, peak (PSS)",
            measured=f"{peak_gb:.2f} GB",
            wanted="<= 1.2 GB",
            is_met=peak_gb <= 1.2,
        ),
    ]


def _floor() -> Line:
    """Measure how fast the machine runs a plain loop at this time, for comparing runs."""
    started_s = time.perf_counter()
    total = 0
    for k in range(FLOOR_LOOPS):
        total += k
    took_s = time.perf_counter() - started_s
    return Line(what="plain loop of 2 million steps", measured=f"{1e3 * took_s:.0f} ms", wanted="(floor)", is_met=None)


def clear_stop(client: Client) -> None:
    """Reset a latched stop."""
    stop = client.get("/v1/stop")
    if stop["is_latched"]:
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})


def run_to_end(client: Client, path: str, body: Any) -> dict[str, Any]:
    """Start a task and wait for its end."""
    task = client.post(path, body)
    while task["state"] not in ("succeeded", "failed", "cancelled"):
        time.sleep(0.2)
        task = client.get(f"/v1/tasks/{task['id']}")
    done: dict[str, Any] = task
    return done


def _stops_while_rendering(client: Client, stop_url: str) -> list[float]:
    """Return the seconds from POST to the answer of the stop process, while another thread requests images."""
    base, path = stop_url.rsplit("/v1/", 1)[0], "/v1/stop"
    stopper, ending = Client(url=base), threading.Event()

    def render() -> None:
        while not ending.is_set():
            client.fetch("GET", "/v1/devices/wrist_camera/reading?format=png")

    thread = threading.Thread(target=render, daemon=True)
    thread.start()
    times: list[float] = []
    try:
        for _ in range(STOPS):
            started_s = time.perf_counter()
            stopper.post(path)
            times.append(time.perf_counter() - started_s)
            time.sleep(0.02)
    finally:
        ending.set()
        thread.join(timeout=10.0)
    return times


class _Memory:
    """Peak of the proportional set size of this process and its children, sampled twice per second."""

    def __init__(self) -> None:
        self.peak_bytes = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Memory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def _watch(self) -> None:
        me = psutil.Process()
        while not self._ending.wait(0.5):
            total = 0
            for process in (me, *me.children(recursive=True)):
                try:
                    total += int(process.memory_full_info().pss)
                except psutil.Error:
                    continue  # it ended between listing and asking
            self.peak_bytes = max(self.peak_bytes, total)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
