"""Ticks of the control thread: `python -m benchmarks.ticks [--seconds 60] [--quiet]`.

Runs the control thread over fake devices (`benchmarks.control_probe`) at 250 Hz with real-time priority and at 125 Hz without
privileges, beside a service with the same privileges that runs missions while clients in a session of their own ask for readings
and pictures. A bare loop that does nothing but wait (the floor) runs beside each at the same rate and priority. A tick is missed
when it comes later than 1.5 periods.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from benchmarks.control_probe import REALTIME, Ticks, control_probe
from hal.errors import CellError
from service.chaos.plant import Plant, serve_command
from service.client import Client
from service.processes.latch import Latch

ROOT = Path(__file__).resolve().parents[1]
START_S = 400.0
UNPRIVILEGED = () if os.geteuid() else ("setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice")
FLOOR = """
import json, sys, time
period_s, seconds, stamps_s = float(sys.argv[1]), float(sys.argv[2]), []
next_s = time.monotonic()
while len(stamps_s) < seconds / period_s:
    stamps_s.append(time.monotonic())
    next_s = max(next_s + period_s, stamps_s[-1])
    time.sleep(max(0.0, next_s - time.monotonic()))
print(json.dumps(stamps_s))
"""
LOADS = ("/v1/devices/wrist_camera/reading?format=png", "/v1/devices", "/v1/stop", "/v1/tasks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--quiet", action="store_true", help="without the service and its clients")
    parser.add_argument("--ask", type=int, metavar="PORT", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.ask:
        _ask(given.ask)
    print("| rate, priority | loop | ticks | missed | off by ms, median | p99 | p99.9 | load |")
    print(f"|{' --- |' * 8}", flush=True)
    with _mix((), is_quiet=given.quiet):
        realtime = measure("250 Hz, real-time", 250.0, REALTIME, given.seconds)
    with _mix(UNPRIVILEGED, is_quiet=given.quiet):
        ordinary = measure("125 Hz, without privileges", 125.0, UNPRIVILEGED, given.seconds)
    is_good = realtime.p99_s <= 0.0005 and realtime.missed <= 0.001 and ordinary.missed <= 0.005
    print(
        f"250 Hz real-time: p99 {1e3 * realtime.p99_s:.2f} ms, missed {realtime.missed:.2%} (pass: 0.5 ms, 0.1 %); "
        f"125 Hz: missed {ordinary.missed:.2%} (pass: 0.5 %)"
    )
    return int(not is_good)


def measure(name: str, rate_hz: float, prefix: Sequence[str], seconds: float) -> Ticks:
    """Run the control thread and the floor beside each other; print both and return the thread's ticks."""
    with tempfile.TemporaryDirectory() as folder:
        latch = Latch.create(Path(folder) / "latch")
        latch.reset("the benchmark", seen_count=latch.state().count)
        with control_probe(Path(folder) / "latch", rate_hz=rate_hz, prefix=prefix) as probe:
            command = [*prefix, sys.executable, "-c", FLOOR, str(1.0 / rate_hz), str(seconds)]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, process_group=0) as floor:
                found = probe.ticks(seconds)
                assert floor.stdout is not None
                bare = Ticks.of(json.loads(floor.stdout.readline()), 1.0 / rate_hz)
        latch.close()
    for loop, ticks in (("control thread", found), ("bare loop", bare)):
        off = " | ".join(f"{1e3 * x:.2f}" for x in (ticks.p50_s, ticks.p99_s, ticks.p999_s))
        print(
            f"| {name} | {loop} | {ticks.count} | {ticks.missed:.2%} | {off} | {os.getloadavg()[0]:.0f} |", flush=True
        )
    return found


@contextmanager
def _mix(prefix: Sequence[str], *, is_quiet: bool) -> Iterator[None]:
    """Run missions one after the other, and clients that ask without a pause; `prefix` comes before the service's command."""
    if is_quiet:
        yield
        return
    command = serve_command(ROOT / "cells/bench.toml", None)
    folder = tempfile.TemporaryDirectory()
    plant = Plant(command=lambda *given: (*prefix, *command(*given)), runs=Path(folder.name) / "runs")
    end = threading.Event()
    try:
        plant.start()
        plant.await_ready(START_S)
        threading.Thread(target=_missions, args=(plant, end), daemon=True).start()
        ask = [sys.executable, "-m", "benchmarks.ticks", "--ask", str(plant.port)]
        with subprocess.Popen(ask, cwd=ROOT, start_new_session=True) as clients:
            try:
                yield
            finally:
                clients.kill()
    finally:
        end.set()
        plant.end()
        plant.sweep()
        folder.cleanup()


def _ask(port: int) -> None:
    """Be a client of each of the loads, until killed."""

    def repeat(path: str) -> None:
        while True:
            with suppress(CellError):
                Client(url=f"http://127.0.0.1:{port}", timeout_s=10.0).fetch("GET", path)

    with ThreadPoolExecutor(len(LOADS)) as pool:
        list(pool.map(repeat, LOADS))


def _missions(plant: Plant, end: threading.Event) -> None:
    while not end.wait(0.5):
        with suppress(CellError):
            tasks = plant.client().get("/v1/tasks")["tasks"]
            if all(task["state"] in ("succeeded", "failed", "cancelled") for task in tasks):
                plant.client().post("/v1/missions", {"file": "demo"})


if __name__ == "__main__":
    raise SystemExit(main())
