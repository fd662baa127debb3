"""Loses processes of a cell, and its clients: `python -m benchmarks.losses [--times 20] [--cell FILE]`.

Kills, suspends and hangs a process, and measures the time from the signal to the latched stop, which the control thread reads at
its next tick, and the time until the cell is ready again. A hung process sleeps in a call that holds the lock of Python, so that
none of its threads goes on; one that computes holds the lock while it counts. Prints a table and the pass line: each loss is
noticed within 120 ms. A process that computes is told apart from one that hangs, has a limit of its own, and is outside of the
pass line.

Of a lost client it measures the time from the end of its window (that of the lease; none where a connection breaks) to the first
set-point that brakes.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.lost_clients import WAYS, scene
from hal.config import load_cell
from service.processes.latch import LATCH, Latch
from service.processes.supervisor import Supervisor

ROOT = Path(__file__).resolve().parents[1]
PASS_S, PASS_CLIENT_S = 0.12, 0.05
LONGEST_S = 60.0
SIGNALS = {
    "killed": signal.SIGKILL,
    "suspended": signal.SIGSTOP,
    "hung": signal.SIGUSR1,
    "computing": signal.SIGUSR2,
}
OUTSIDE = "computing"
HANGING = """
import ctypes, signal
library = ctypes.PyDLL(None)  # its calls keep the lock of Python
signal.signal(signal.SIGUSR1, lambda *_: library.sleep(1000))
signal.signal(signal.SIGUSR2, lambda *_: sum(range(10**12)))
"""
SERVICE = """
import sys, threading
from pathlib import Path
from hal.config import load_cell
from service.processes.supervisor import Supervisor
supervisor = Supervisor(load_cell(Path(sys.argv[1])))
supervisor.start()
print(supervisor.folder, flush=True)
threading.Event().wait()
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """How long it took until the stop was latched, and until the cell was ready again (zero for a lost service)."""

    noticed_s: float
    ready_s: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if the pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    parser.add_argument("--only", default="", help="one process or one way, such as `cell`, `client` or `hung`")
    parser.add_argument("--seed", type=int, default=1, help="of the moments at which clients are lost")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="panelwright-losses-") as folder:
        (Path(folder) / "sitecustomize.py").write_text(
            HANGING, encoding="utf-8"
        )  # every Python imports it at its start
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (folder, os.environ.get("PYTHONPATH"))))
        return _measure(given)


def _measure(given: argparse.Namespace) -> int:
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("| lost | how | times | noticed ms, median | p99 | longest | ready again s, median | longest |")
    print(f"|{' --- |' * 8}", flush=True)
    latest_s = 0.0
    for name in ("cell", "stop", "service"):
        for how, number in SIGNALS.items():
            if given.only not in ("", name, how):
                continue
            losses = [one(name, number, given.cell) for _ in range(given.times)]
            noticed = np.array([loss.noticed_s for loss in losses])
            ready = [loss.ready_s for loss in losses]
            latest_s = max(latest_s, 0.0 if how == OUTSIDE else float(np.quantile(noticed, 0.99)))
            _print_row(name, how, noticed, f"{np.median(ready):.1f} | {max(ready):.1f}")
    client_s = _lost_clients(given)
    print(f"noticed: p99 {1e3 * latest_s:.0f} ms in the worst line of a process (pass: {1e3 * PASS_S:.0f} ms)")
    print(
        f"braking for a lost client: p99 {1e3 * client_s:.0f} ms after its window (pass: {1e3 * PASS_CLIENT_S:.0f} ms)"
    )
    return int(latest_s > PASS_S or client_s > PASS_CLIENT_S)


def _lost_clients(given: argparse.Namespace) -> float:
    """Lose clients and print a row for each way; returns the 99th percentile of the worst row."""
    ways = {how: lose for how, lose in WAYS.items() if given.only in ("", "client", how)}
    if not ways:
        return 0.0
    latest_s = 0.0
    chance = random.Random(given.seed)
    with scene() as at:
        for how, lose in ways.items():
            late_s = np.array([lose(at, chance) for _ in range(given.times)])
            latest_s = max(latest_s, float(np.quantile(late_s, 0.99)))
            _print_row("client", how, late_s, "- | -")
    return latest_s


def _print_row(name: str, how: str, noticed_s: NDArray[np.float64], ready: str) -> None:
    p50, p99, longest = (1e3 * float(x) for x in np.quantile(noticed_s, (0.5, 0.99, 1.0)))
    print(f"| {name} | {how} | {len(noticed_s)} | {p50:.0f} | {p99:.0f} | {longest:.0f} | {ready} |", flush=True)


def one(name: str, number: signal.Signals, cell: Path) -> Loss:
    """Lose a process once."""
    if name == "service":
        return _service(number, cell)
    supervisor = Supervisor(load_cell(cell))
    try:
        supervisor.start()
        pid = next(process.pid for process in supervisor.processes() if process.name == name)
        assert pid is not None
        begun_s = time.monotonic()
        os.kill(pid, number)
        noticed_s = _until(supervisor.latch.is_set) - begun_s

        def is_back() -> bool:
            health = next(process for process in supervisor.processes() if process.name == name)
            return health.pid != pid and health.is_alive and supervisor.is_ready

        return Loss(noticed_s=noticed_s, ready_s=_until(is_back) - begun_s)
    finally:
        supervisor.close()


def _service(number: signal.Signals, cell: Path) -> Loss:
    with _served(cell) as (process, folder), Latch(folder / LATCH) as latch:
        begun_s = time.monotonic()
        os.kill(process.pid, number)
        return Loss(noticed_s=_until(latch.is_set) - begun_s, ready_s=0.0)


@contextmanager
def _served(cell: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    command = [sys.executable, "-P", "-c", SERVICE, str(cell)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, Path(process.stdout.readline().strip())
        finally:
            process.kill()


def _until(is_true: Callable[[], bool]) -> float:
    """Return the monotonic time at which a condition became true."""
    pause, end_s = threading.Event(), time.monotonic() + LONGEST_S
    while not is_true():
        if time.monotonic() > end_s:
            raise TimeoutError(f"not true after {LONGEST_S:.0f} s")
        pause.wait(0.0005)
    return time.monotonic()


if __name__ == "__main__":
    raise SystemExit(main())
