"""Ends `panelwright serve` by signals in twenty situations: `python -m benchmarks.signals`.

Each moment (from the first instant to the middle of a motion) meets SIGINT, SIGTERM, SIGHUP and Ctrl-C pressed twice. An end passes
when the service and all its processes are gone within `--within` seconds, without a traceback. The exit code is 1 otherwise.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hal.errors import CellError
from service.chaos.judge import TRACEBACK
from service.chaos.plant import Plant, serve_command

ROOT = Path(__file__).parents[1]
START_S = 400.0
TWICE_S = 0.2
WAYS = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM, "SIGHUP": signal.SIGHUP, "Ctrl-C twice": signal.SIGINT}


def at_once(_plant: Plant) -> None:
    """Wait for the first line that the service prints, so that it handles signals."""
    end_s = time.monotonic() + START_S
    while not _plant.lines and time.monotonic() < end_s:
        time.sleep(0.01)


def while_starting(plant: Plant) -> None:
    """Wait until its cell has begun to start."""
    at_once(plant)
    end_s = time.monotonic() + START_S
    while "cell" not in plant.roles() and time.monotonic() < end_s:
        time.sleep(0.01)


def ready(plant: Plant) -> None:
    """Wait until it is ready, then leave a silent connection and half an upload."""
    plant.await_ready(START_S)
    for data in (b"GET /he", b"POST /v1/images HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 900000\r\n\r\nabc"):
        socket.create_connection(("127.0.0.1", plant.port)).sendall(data)


def mission_begun(plant: Plant) -> None:
    """Begin a mission, and follow its events as another client does."""
    plant.await_ready(START_S)
    task = plant.client().post("/v1/missions", {"file": "demo"})

    def follow() -> None:
        with contextlib.suppress(CellError):
            list(plant.client(60.0).events(task["id"]))

    threading.Thread(target=follow, daemon=True).start()


def in_motion(plant: Plant) -> None:
    """Begin a mission and wait until the arm moves."""
    plant.await_ready(START_S)
    task = plant.client().post("/v1/missions", {"file": "demo"})
    end_s = time.monotonic() + START_S
    while plant.client().get(f"/v1/tasks/{task['id']}")["fraction"] <= 0.06 and time.monotonic() < end_s:
        time.sleep(0.05)


MOMENTS: tuple[Callable[[Plant], None], ...] = (at_once, while_starting, ready, mission_begun, in_motion)


def end_of(moment: Callable[[Plant], None], way: str, *, within_s: float, cell: Path) -> tuple[float, list[str]]:
    """Return the seconds that an end took, and what was wrong with it."""
    with tempfile.TemporaryDirectory() as folder:
        plant = Plant(command=serve_command(cell, None), runs=Path(folder) / "runs")
        try:
            plant.start()
            moment(plant)
            if "twice" in way:
                pid = plant.pid
                threading.Timer(TWICE_S, lambda: os.kill(pid, signal.SIGINT) if plant.is_alive() else None).start()
            taken_s = plant.end(WAYS[way])
            wrong = ["still there"] if plant.is_alive() else []
            wrong += [f"{len(plant.survivors())} orphans"] if plant.survivors() else []
            wrong += [f"{taken_s:.1f} s"] if taken_s > within_s else []
            wrong += ["a traceback"] if any(TRACEBACK in line for line in plant.lines) else []
        finally:
            plant.sweep()
    return taken_s, wrong


def main() -> None:
    """Run all situations and print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--within", type=float, default=5.0, help="seconds that an end may take")
    options.add_argument("--cell", type=Path, default=ROOT / "cells" / "bench.toml")
    given = options.parse_args()
    print("| moment | way | gone after s | wrong |\n| --- | --- | --- | --- |")
    good = 0
    for moment in MOMENTS:
        for way in WAYS:
            taken_s, wrong = end_of(moment, way, within_s=given.within, cell=given.cell)
            good += not wrong
            print(f"| {moment.__name__.replace('_', ' ')} | {way} | {taken_s:.1f} | {', '.join(wrong)} |", flush=True)
    total = len(MOMENTS) * len(WAYS)
    print(f"{good} of {total} passed")
    sys.exit(0 if good == total else 1)


if __name__ == "__main__":
    main()
