"""Small requests with a key beside `wrk`: `python -m benchmarks.requests [--seconds 10] [--path /v1/lease]`.

Serves the simulated bench cell with keys in a process of its own; `wrk` (from Debian, written in C) asks for a small state with the
key of an observer over 16 connections. Prints requests a second and latencies, and the pass lines.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

from hal.child_python import module_command
from service.chaos.plant import Plant, serve_command

ROOT = Path(__file__).resolve().parents[1]
PASS_HZ, PASS_P99_S = 1500.0, 0.020
CONNECTIONS = 16
START_S = 400.0
REST_SHARE = 0.12  # of one processor
UNITS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=10)
    parser.add_argument("--path", default="/v1/lease")
    parser.add_argument("--connections", type=int, default=CONNECTIONS)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    given = parser.parse_args(arguments)
    if shutil.which("wrk") is None:
        print("skipped: wrk is missing (apt-get install wrk)")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder) / "runs"
        key = _new_key(runs)
        plant = Plant(command=serve_command(given.cell, None), runs=runs, key=key)
        try:
            plant.start()
            plant.await_ready(START_S)
            _await_rest(psutil.Process(plant.pid))
            wrk(plant.port, given.path, key, seconds=2, connections=given.connections)  # warm
            load = os.getloadavg()[0]
            service = psutil.Process(plant.pid)
            before_s = _cpu_s(service)
            rate_hz, quantiles_s, wrong = wrk(
                plant.port, given.path, key, seconds=given.seconds, connections=given.connections
            )
            cpu_s = _cpu_s(service) - before_s
        finally:
            plant.end()
            plant.sweep()
    told = ", ".join(f"p{name} {1e3 * value:.1f} ms" for name, value in quantiles_s.items())
    print(f"GET {given.path} with a key, {given.connections} connections, {given.seconds} s, load before {load:.1f}:")
    print(f"{rate_hz:.0f}/s, {told}, answers other than 200: {wrong}")
    print(f"CPU of the service for each: {1e3 * cpu_s / (rate_hz * given.seconds):.2f} ms, more on a busy machine")
    p99_s = quantiles_s["99"]
    print(f"pass: {PASS_HZ:.0f}/s, p99 {1e3 * PASS_P99_S:.0f} ms")
    return int(rate_hz < PASS_HZ or p99_s > PASS_P99_S or wrong > 0)


def _await_rest(service: psutil.Process) -> None:
    """Wait until the service computes little: after it is ready, it still loads what missions need."""
    begun_s = time.monotonic()
    share = 1.0
    while share > REST_SHARE and time.monotonic() - begun_s < START_S:
        before_s, asked_s = _cpu_s(service), time.monotonic()
        time.sleep(1.0)
        share = (_cpu_s(service) - before_s) / (time.monotonic() - asked_s)


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _new_key(runs: Path) -> str:
    """Make the key of an observer and return it."""
    runs.mkdir(parents=True)
    command = module_command("service.cli", "keys", "add", "bench", "--role", "observer", "--runs", str(runs))
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = re.search(r"pw_[\w-]+", told)
    assert found is not None, told
    return found[0]


def wrk(port: int, path: str, key: str, *, seconds: int, connections: int) -> tuple[float, dict[str, float], int]:
    """Run the load generator; returns requests a second, latencies by percentile, and the number of wrong answers."""
    url = f"http://127.0.0.1:{port}{path}"
    command = [
        "wrk",
        "-t1",
        f"-c{connections}",
        f"-d{seconds}s",
        "--latency",
        "-H",
        f"Authorization: Bearer {key}",
        url,
    ]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rate = re.search(r"Requests/sec:\s+([\d.]+)", told)
    quantiles = {name: float(x) * UNITS[unit] for name, x, unit in re.findall(r"(\d+)%\s+([\d.]+)(us|ms|s)", told)}
    wrong = re.search(r"Non-2xx or 3xx responses: (\d+)", told)
    assert rate is not None, told
    return float(rate[1]), quantiles, int(wrong[1]) if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
