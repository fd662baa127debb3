"""Stops under load: `python -m benchmarks.stops [--times 300] [--cell FILE]`.

Starts the service in processes of its own and sends `POST /v1/stop` to the stop port while clients load the main port. Measures
the time from the request to the set latch, which the control thread reads at its next tick, and how many stops were missed.
Then 50 listeners take the stream while a mission runs. Prints tables and pass lines.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
from websockets.sync.client import connect

from service.processes.latch import LATCH, Latch

ROOT = Path(__file__).resolve().parents[1]
PASS_S = 0.010
PASS_SHARE, PASS_LAG_S = 0.97, 0.020
LONGEST_S = 1.0
LISTENERS, STREAM_S, RATE_HZ = 50, 15.0, 20.0
SERVICE = """
import sys
from pathlib import Path
from hal.config import load_cell
from service.serve import Options, Panelwright
panelwright = Panelwright(load_cell(Path(sys.argv[1])), Options(port=0, runs_dir=Path(sys.argv[2])))
panelwright.start()
print(panelwright.url, panelwright.stop_port, panelwright.service.supervisor.folder, flush=True)
sys.stdin.read()
panelwright.close()
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Served:
    """A running service: its address, its stop port and its latch."""

    url: str
    stop_port: int
    latch: Latch

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        host, _, port = self.url.removeprefix("http://").partition(":")
        return host, int(port)

    def client(self) -> httpx2.Client:
        """Return a client of the main port."""
        return httpx2.Client(base_url=self.url, timeout=30.0, trust_env=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=300)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    given = parser.parse_args(arguments)
    worst_s, missed = 0.0, 0
    print("| load | stops | missed | ms, median | p99 | longest |")
    print(f"|{' --- |' * 6}", flush=True)
    with _served(given.cell) as served:
        for name, load in LOADS.items():
            with load(served):
                taken = np.array([_stop(served) for _ in range(given.times)])
            lost = int(np.isnan(taken).sum())
            worst_s, missed = max(worst_s, float(np.nanquantile(taken, 0.99))), missed + lost
            figures = [1e3 * float(x) for x in (np.nanmedian(taken), np.nanquantile(taken, 0.99), np.nanmax(taken))]
            print(f"| {name} | {len(taken)} | {lost} | " + " | ".join(f"{x:.1f}" for x in figures) + " |", flush=True)
        share, lag_s = _streams(served)
    print(f"stops: p99 {1e3 * worst_s:.1f} ms in the worst line, {missed} missed (pass: {1e3 * PASS_S:.0f} ms, 0)")
    print(f"{LISTENERS} listeners: lowest share {share:.1%}, lag p99 {1e3 * lag_s:.0f} ms (pass: 97 %, 20 ms)")
    return int(worst_s > PASS_S or missed > 0 or share < PASS_SHARE or lag_s > PASS_LAG_S)


def _stop(served: Served) -> float:
    """Return the seconds from a stop to the set latch, NaN when it was not set; reset it afterwards."""
    with served.client() as client:
        state = client.get("/v1/stop").json()
        if state["is_latched"]:
            client.post("/v1/stop/reset", json={"seen_count": state["count"]}).raise_for_status()
    with socket.create_connection(("127.0.0.1", served.stop_port)) as link:
        begun_s = time.perf_counter()
        link.sendall(b"POST /v1/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        while not served.latch.is_set():
            if time.perf_counter() - begun_s > LONGEST_S:
                return float("nan")
        taken_s = time.perf_counter() - begun_s
        while link.recv(4096):  # the answer comes when the stop is recorded
            pass
    return taken_s


@contextmanager
def _idle(_served: Served) -> Iterator[None]:
    yield


def _repeating(
    ask: Callable[[httpx2.Client], object], clients: int
) -> Callable[[Served], contextlib.AbstractContextManager[None]]:
    """Return a load of clients that repeat a request without a pause."""

    @contextmanager
    def load(served: Served) -> Iterator[None]:
        end = threading.Event()

        def run() -> None:
            with served.client() as client:
                while not end.is_set():
                    with contextlib.suppress(httpx2.HTTPError):
                        ask(client)

        threads = [threading.Thread(target=run, daemon=True) for _ in range(clients)]
        for thread in threads:
            thread.start()
        yield
        end.set()
        for thread in threads:
            thread.join(60.0)

    return load


@contextmanager
def _silent(served: Served) -> Iterator[None]:
    with ExitStack() as crowd:
        for _ in range(400):
            crowd.enter_context(socket.create_connection(served.address))
        yield


BIG = json.dumps({"point_m": [0.0] * 150_000})
LOADS: dict[str, Callable[[Served], contextlib.AbstractContextManager[None]]] = {
    "idle": _idle,
    "10 GET": _repeating(lambda client: client.get("/v1/devices"), 10),
    "frames": _repeating(lambda client: client.get("/v1/devices/wrist_camera/reading?format=png"), 4),
    "perception": _repeating(lambda client: client.post("/v1/recognise?wait_s=30", json={}), 2),
    "big JSON": _repeating(
        lambda client: client.post("/v1/fuse", content=BIG, headers={"Content-Type": "application/json"}), 4
    ),
    "full pool": _repeating(lambda client: client.get("/v1/devices/range_scanner/reading?format=npz"), 45),
    "400 silent": _silent,
    "10 pages": _repeating(lambda client: (client.get("/"), client.get("/readyz"), client.get("/v1/tasks")), 10),
}


def _streams(served: Served) -> tuple[float, float]:
    """Return the lowest share of samples that a listener got beside a mission, and the event loop's lag (p99)."""
    with served.client() as client:
        state = client.get("/v1/stop").json()
        client.post("/v1/stop/reset", json={"seen_count": state["count"]})
        client.post("/v1/missions", json={}).raise_for_status()
        counts = [0] * LISTENERS
        end_s = time.monotonic() + STREAM_S

        def listen(number: int) -> None:
            with connect(f"ws://127.0.0.1:{served.address[1]}/v1/stream", proxy=None, open_timeout=60) as stream:
                while time.monotonic() < end_s:
                    stream.recv(timeout=STREAM_S)
                    counts[number] += 1

        threads = [threading.Thread(target=listen, args=(number,)) for number in range(LISTENERS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        lag_s = float(client.get("/v1/info").json()["event_loop_lag_p99_s"])
    return min(counts) / (RATE_HZ * STREAM_S), lag_s


@contextmanager
def _served(cell: Path) -> Iterator[Served]:
    with tempfile.TemporaryDirectory() as runs:
        command = [sys.executable, "-P", "-c", SERVICE, str(cell), runs]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None and process.stdin is not None
            url, stop_port, folder = process.stdout.readline().split()
            with Latch(Path(folder) / LATCH) as latch:
                yield Served(url=url, stop_port=int(stop_port), latch=latch)
            process.stdin.close()
            process.wait(60.0)


if __name__ == "__main__":
    raise SystemExit(main())
