"""Figures of the plant with a running service: a reading until it is visible, and the trend of a year. See `benchmarks.plant`."""

from __future__ import annotations

import math
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import tomlkit

from hal.config import load_cell
from service.commissioning.new_cell import copy_cell
from service.history.reading import VALID, StoredReading
from service.history.store import History
from service.serve import Options, Panelwright

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "cells/bench.toml"
YEAR_H, OBJECTS, BUCKETS = 8760, 20, 200
PROBE_S = 0.02  # between two probes
CLIENTS = """
import sys, threading
import httpx2
url, count = sys.argv[1], int(sys.argv[2])
def follow():
    with httpx2.Client(base_url=url, timeout=60.0, trust_env=False) as client:
        while "readings_after" not in (found := client.get("/v1/feed").json()):
            threading.Event().wait(0.5)  # the service is busy
        at = {"readings_after": found["readings_after"], "alarms_after": found["alarms_after"]}
        while True:
            found = client.get("/v1/feed", params={**at, "wait_s": 30.0}).json()
            at = {name: found.get(name, at[name]) for name in at}
threads = [threading.Thread(target=follow, daemon=True) for _ in range(count)]
for thread in threads:
    thread.start()
print("ready", flush=True)
sys.stdin.read()
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Durable:
    """Times from a reading that is handed over until it is on disk and a new question sees it, s."""

    times_s: tuple[float, ...]
    missions: int
    clients: int
    outlets: tuple[str, ...]

    def quantile_s(self, share: float) -> float:
        """Return a quantile."""
        return float(np.quantile(self.times_s, share))


def durable(*, missions: int = 3, clients: int = 50, inline: bool = False) -> Durable:
    """Measure with missions running, so many clients that follow the feed, and webhook and Prometheus outlets."""
    with tempfile.TemporaryDirectory(prefix="panelwright-plant-") as folder, _receiver() as hook:
        cell, outlets = _cell_with_outlets(Path(folder), hook)
        panelwright = Panelwright(load_cell(cell), Options(port=0, runs_dir=Path(folder) / "runs", inline=inline))
        try:
            panelwright.start()
            command = [sys.executable, "-P", "-c", CLIENTS, panelwright.url, str(clients)]
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as followers:
                assert followers.stdout is not None
                assert followers.stdout.readline().strip() == "ready"
                try:
                    times = _probed(panelwright, missions)
                finally:
                    followers.kill()
        finally:
            panelwright.close()
    return Durable(times_s=tuple(times), missions=missions, clients=clients, outlets=outlets)


def _probed(panelwright: Panelwright, missions: int) -> list[float]:
    """Return the times of probes while missions run one after the other."""
    service, plant = panelwright.service, panelwright.service.plant
    request = service.operations["missions"].request_model.model_validate({"file": "inspect"})
    reader, times, pause = plant.history.reader(), list[float](), threading.Event()
    for _ in range(missions):
        task = service.submit("missions", request)
        while not task.state.is_final:
            number = len(times)
            one = _reading("probe", time.time(), float(number))
            begun_s = time.perf_counter()
            plant.history.add([one])
            for listen in plant.observations.listeners:
                listen([one])
            seen = reader.page(plant.history.ask(object="probe"), after=reader.newest_id() - 1, limit=5)
            times.append(time.perf_counter() - begun_s)
            if not any(row.reading.value == float(number) for row in seen):
                raise AssertionError(f"reading {number} is not visible after it was stored")
            pause.wait(PROBE_S)
        if task.problem is not None:
            raise AssertionError(f"the mission has failed: {task.problem['detail']}")
    return times


def _reading(name: str, utc_s: float, value: float) -> StoredReading:
    return StoredReading(
        object=name, kind="gauge", utc_s=utc_s, cell_s=0.0, quality=VALID, value=value, unit="bar", sigma=0.02,
        confidence=0.9, verb="missions", task="t", mission="m",
    )  # fmt: skip


def _cell_with_outlets(folder: Path, hook: str) -> tuple[Path, tuple[str, ...]]:
    """Return the bench cell with limits and outlets, and the names of the outlets."""
    copied = copy_cell(BENCH, folder / "plant")
    document = tomlkit.parse(copied.cell.read_text(encoding="utf-8"))
    (folder / "plant/cells/hook.secret").write_text("0123456789abcdef0123456789abcdef\n")
    (folder / "plant/cells/hook.secret").chmod(0o600)
    outlets: dict[str, dict[str, object]] = {
        "webhook": {"url": hook, "secret_file": "hook.secret", "events": ["alarms", "readings"]},
        "prometheus": {"port": _free_port()},
    }
    document["outlets"] = outlets
    copied.cell.write_text(tomlkit.dumps(document), encoding="utf-8")
    return copied.cell, tuple(outlets)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextmanager
def _receiver() -> Iterator[str]:
    """Yield the address of a webhook that takes everything."""

    class Taker(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_given: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Taker)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()


def trend(*, hours: int = YEAR_H, objects: int = OBJECTS) -> list[float]:
    """Return the times in seconds of the trend of each object over all of a history of hourly readings."""
    rng, now_s = random.Random(7), 1_790_000_000.0
    with tempfile.TemporaryDirectory(prefix="panelwright-plant-") as folder:
        history = History(Path(folder), cell="bench", panel="bench", now_s=lambda: now_s)
        try:
            for day in range(0, hours, 24):
                history.add(
                    [
                        _reading(
                            f"object_{k}",
                            now_s - 3600.0 * (hours - hour),
                            5.0 + math.sin(hour / 24.0 + k) + rng.gauss(0.0, 0.02),
                        )
                        for hour in range(day, min(day + 24, hours))
                        for k in range(objects)
                    ]
                )
            times = []
            for k in range(objects):
                begun_s = time.perf_counter()
                buckets = history.reader().trend(history.ask(object=f"object_{k}"), buckets=BUCKETS)
                times.append(time.perf_counter() - begun_s)
                if sum(bucket.count for bucket in buckets) != hours:
                    raise AssertionError("the trend does not count every reading")
        finally:
            history.close()
    return times
