"""Figures of the plant with a running service: a reading until it is visible, and the trend of a year. See `benchmarks.plant`."""

from __future__ import annotations

import json
import math
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.stops import all_outlets, wait_for_outlets
from hal.config import load_cell
from hal.priorities import promptly
from service.commissioning.new_cell import copy_cell
from service.history.reading import VALID, StoredReading
from service.history.store import History
from service.serve import Options, Panelwright

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "cells/bench.toml"
YEAR_H, OBJECTS, BUCKETS = 8760, 20, 200
PROBE_S = 0.02  # between two probes
FLOOR_PROBES = 200
FIRST = """
import os
try:
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(50))
except OSError:
    pass
"""  # what measures does not wait for turns
FOLLOWERS = (
    FIRST
    + """
import json, selectors, socket, sys, time
address, path, count = (sys.argv[1], int(sys.argv[2])), sys.argv[3], int(sys.argv[4])
asked = f"GET {path} HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\n\\r\\n".encode()
ready, rest, seen = selectors.DefaultSelector(), {}, {}
for _ in range(count):
    link = socket.create_connection(address)
    link.sendall(asked)
    ready.register(link, selectors.EVENT_READ)
    rest[link] = b""
started = set()
ready.register(sys.stdin, selectors.EVENT_READ)
while True:
    for key, _ in ready.select():
        if key.fileobj is sys.stdin:
            print(json.dumps(seen), flush=True)
            raise SystemExit
        data = key.fileobj.recv(262144)
        now_s = time.monotonic()
        if not data:
            raise SystemExit("the service ended a stream")
        if key.fileobj not in started:
            started.add(key.fileobj)
            if len(started) == count:
                print("ready", flush=True)
        *events, rest[key.fileobj] = (rest[key.fileobj] + data).split(b"\\n\\n")
        for event in events:
            for part in event.split(b'"object":"probe"')[1:]:
                number = part.split(b'"value":', 1)[1].split(b",", 1)[0].decode()
                seen.setdefault(number, []).append(now_s)
"""
)
DISK = (
    FIRST
    + """
import json, select, sys, time
file, times = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT), []
os.write(file, bytes(4096 * 100))
os.fsync(file)
while not select.select([sys.stdin], [], [], float(sys.argv[2]))[0]:
    os.pwrite(file, os.urandom(4096), 4096 * (len(times) % 100))
    begun = time.monotonic()
    os.fdatasync(file)
    times.append(time.monotonic() - begun)
print(json.dumps(times), flush=True)
"""
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Durable:
    """Times from a reading that is handed over, s.

    Attributes:
        stored_s: until it is on disk and a new question sees it.
        first_s: until the first of the followers is told, over HTTP.
        each_s: until a follower is told, one entry a follower.
        floor_s: as `each_s`, from a server that does nothing but write to the followers, with nothing else running.
        disk_s: until 4 kB are on disk, of a process with real-time priority that does nothing else, beside all of this.
    """

    stored_s: tuple[float, ...]
    first_s: tuple[float, ...]
    each_s: tuple[float, ...]
    floor_s: tuple[float, ...]
    disk_s: tuple[float, ...]
    missions: int
    clients: int
    outlets: tuple[str, ...]


def durable(*, missions: int = 3, clients: int = 50, inline: bool = False) -> Durable:
    """Measure with missions running, all outlets, and so many clients that follow the feed's events in another process."""
    floor = _floor(clients)
    with tempfile.TemporaryDirectory(prefix="panelwright-plant-") as folder, all_outlets() as outlets:
        cell = load_cell(copy_cell(BENCH, Path(folder) / "plant").cell)
        cell = cell.model_copy(update={"file": cell.file.model_copy(update={"outlets": outlets})})
        panelwright = Panelwright(cell, Options(port=0, runs_dir=Path(folder) / "runs", inline=inline))
        try:
            panelwright.start()
            if not inline:
                wait_for_outlets(outlets)
            port = int(panelwright.url.rsplit(":", 1)[1])
            with _followers(port, "/v1/feed/events", clients) as told, _disk(Path(folder) / "disk") as written:
                begun_s, stored_s = _probed(panelwright, missions)
                disk_s, seen = written(), told()
        finally:
            panelwright.close()
    each = _delays(begun_s, seen, clients)
    return Durable(
        stored_s=tuple(stored_s),
        first_s=tuple(min(one) for one in each),
        each_s=tuple(x for one in each for x in one),
        floor_s=floor,
        disk_s=tuple(disk_s),
        missions=missions,
        clients=clients,
        outlets=tuple(outlets.model_dump(exclude_none=True)),
    )


@contextmanager
def _followers(port: int, path: str, count: int) -> Iterator[Callable[[], dict[str, list[float]]]]:
    """Follow events in a process of its own; yields what ends it and returns when each probe was seen, by its number."""
    command = [sys.executable, "-P", "-c", FOLLOWERS, "127.0.0.1", str(port), path, str(count)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None

        def told() -> dict[str, list[float]]:
            time.sleep(1.0)  # the last event is on its way
            process.stdin.write("end\n")  # type: ignore[union-attr]  # asserted above
            process.stdin.flush()  # type: ignore[union-attr]
            found: dict[str, list[float]] = json.loads(process.stdout.readline())  # type: ignore[union-attr]
            return found

        try:
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("the followers cannot follow")
            yield told
        finally:
            process.kill()


@contextmanager
def _disk(file: Path) -> Iterator[Callable[[], list[float]]]:
    """Write 4 kB again and again in a process of its own; yields what ends it and returns how long each took to the disk."""
    command = [sys.executable, "-P", "-c", DISK, str(file), str(PROBE_S)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def written() -> list[float]:
            times: list[float] = json.loads(process.communicate("end\n")[0])
            return times

        try:
            yield written
        finally:
            process.kill()


def _delays(begun_s: list[float], seen: dict[str, list[float]], clients: int) -> list[list[float]]:
    """Return the delays of each probe; every follower must have seen every one, once."""
    at = {float(number): times for number, times in seen.items()}
    found = [at.get(float(number), []) for number in range(len(begun_s))]
    lacking = [number for number, times in enumerate(found) if len(times) != clients]
    if lacking:
        raise AssertionError(f"{len(lacking)} readings were not told to each follower once; the first is {lacking[0]}")
    return [[time_s - begun for time_s in times] for begun, times in zip(begun_s, found, strict=True)]


def _floor(clients: int) -> tuple[float, ...]:
    """Return what the followers themselves cost: times from writing an event to each of them until it is seen."""
    begun_s, links = list[float](), list[socket.socket]()
    with socket.create_server(("127.0.0.1", 0), backlog=clients) as server:

        def serve(end: threading.Event) -> None:
            links.extend(server.accept()[0] for _ in range(clients))
            for link in links:
                link.sendall(b"HTTP/1.1 200 OK\r\n\r\n:\n\n")
            end.wait(0.5)
            for number in range(FLOOR_PROBES):
                event = b'data: {"object":"probe","value":%d.0,%b}\n\n' % (number, b" " * 700)
                begun_s.append(time.monotonic())
                for link in links:
                    link.sendall(event)
                end.wait(PROBE_S)
            end.set()

        end = threading.Event()
        threading.Thread(target=serve, args=(end,), daemon=True).start()
        with _followers(server.getsockname()[1], "/", clients) as told:
            end.wait()
            return tuple(x for one in _delays(begun_s, told(), clients) for x in one)


def _probed(panelwright: Panelwright, missions: int) -> tuple[list[float], list[float]]:
    """Return when each probe began, and how long it took to be stored, while missions run one after the other."""
    service, plant = panelwright.service, panelwright.service.plant
    request = service.operations["missions"].request_model.model_validate({"file": "inspect"})
    reader, begun, stored, pause = plant.history.reader(), list[float](), list[float](), threading.Event()
    for _ in range(missions):
        task = service.submit("missions", request)
        while not task.state.is_final:
            number = len(begun)
            one = _reading("probe", time.time(), float(number))
            with promptly():  # the turns that this thread waits for between two calls belong to no reading
                begun.append(time.monotonic())
                plant.observations.keep([one])
                newest = reader.last(plant.history.ask(object="probe"), limit=1)
                stored.append(time.monotonic() - begun[-1])
            if newest[0].reading.value != float(number):
                raise AssertionError(f"reading {number} is not visible after it was stored")
            pause.wait(PROBE_S)
        if task.problem is not None:
            why = service.supervisor.latch.state().source
            raise AssertionError(f"the mission has failed: {task.problem['detail']} (newest stop: {why})")
    return begun, stored


def _reading(name: str, utc_s: float, value: float) -> StoredReading:
    return StoredReading(
        object=name, kind="gauge", utc_s=utc_s, cell_s=0.0, quality=VALID, value=value, unit="bar", sigma=0.02,
        confidence=0.9, verb="missions", task="t", mission="m",
    )  # fmt: skip


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
