"""Loses clients in motions of theirs, for `python -m benchmarks.losses`.

`python -m benchmarks.lost_clients CELL PORT STOP_PORT RUNS` is a service whose fake arm moves at the real pace and notes each
set-point. The holder of a lease gives no further heartbeat, or a client without a lease closes the connection on which it waits.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path

from pydantic import BaseModel

from benchmarks.control_probe import braking_stamps_s, long_motion
from hal.config import load_cell
from hal.strict import Strict
from service.chaos.plant import Plant
from service.exposure import Exposure
from service.operations import Operation, OperationContext
from service.serve import Options, Panelwright
from tests.service.conftest import FAKES, _write

ROOT = Path(__file__).resolve().parents[1]
START_S = 120.0
HEARTBEAT_S = 0.25
BEGUN = 100  # set-points
LIMIT_S = 30.0


class SwingRequest(Strict):
    """Moves the first joint for 20 s."""


class SwingResult(BaseModel):
    """How the motion ended."""

    outcome: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A service whose arm can be moved, and what the arm was told."""

    plant: Plant
    trace: Path

    def swing(self) -> None:
        """Make the arm ready for a motion, and forget what it was told."""
        client = self.plant.client()
        state = client.get("/v1/stop")
        if state["is_latched"]:
            client.post("/v1/stop/reset", {"seen_count": state["count"]})
        while any(task["state"] in ("queued", "running") for task in client.get("/v1/tasks")["tasks"]):
            time.sleep(HEARTBEAT_S)
        self.trace.write_text("")

    def set_points(self) -> tuple[list[float], list[float]]:
        """Return the times of the set-points, and the first joint of each."""
        lines = [line.split() for line in self.trace.read_text().split("\n")[:-1]]
        told = [(float(stamp), float(word)) for word, stamp in lines if word != "stop"]
        return [stamp for stamp, _ in told], [joint for _, joint in told]

    def is_moving(self) -> bool:
        """Return whether the motion goes on for some time."""
        return len(set(self.set_points()[1])) > BEGUN

    def braked_after_s(self, lost_s: float) -> float:
        """Wait until the arm rests; return the time from the loss to the first set-point that brakes."""
        end_s = time.monotonic() + LIMIT_S
        while len(set(self.set_points()[1][-20:])) > 1:
            if time.monotonic() > end_s:
                raise TimeoutError(f"the arm still moves {LIMIT_S:.0f} s after the loss of its client")
            time.sleep(0.05)
        return next(stamp for stamp in braking_stamps_s(*self.set_points()) if stamp > lost_s) - lost_s


@contextlib.contextmanager
def scene() -> Iterator[Scene]:
    """Start the service, and end it."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(FAKES), str(ROOT), before)))
    with tempfile.TemporaryDirectory(prefix="panelwright-losses-") as name:
        trace = Path(name) / "trace"
        cell = _write(Path(name), robot=True, mode="real", options={"arm": {"trace": str(trace)}})

        def command(port: int, stop_port: int, runs: Path) -> list[str]:
            return [sys.executable, "-m", "benchmarks.lost_clients", str(cell), str(port), str(stop_port), str(runs)]

        plant = Plant(command=command, runs=Path(name) / "runs")
        try:
            plant.start()
            plant.await_ready(START_S)
            yield Scene(plant=plant, trace=trace)
        finally:
            plant.end()
            plant.sweep()


def lose_holder(at: Scene, chance: random.Random) -> float:
    """Let the holder of a lease fall silent in its motion; return how long after the lease's time the arm braked."""
    client = at.plant.client()
    at.swing()
    grant = client.post("/v1/lease", {"holder": "benchmark"})
    token = {"Lease-Token": grant["token"]}
    client.post("/v1/swing", {}, headers=token)
    with contextlib.closing(HTTPConnection("127.0.0.1", at.plant.port)) as link:
        while True:
            kept_s = time.monotonic()
            link.request("POST", "/v1/lease/heartbeat", headers=token)
            link.getresponse().read()
            if at.is_moving():
                break
            time.sleep(HEARTBEAT_S * chance.random())
    return at.braked_after_s(kept_s) - float(grant["ttl_s"])


def lose_connection(at: Scene, chance: random.Random) -> float:
    """Close the connection on which the client of a motion waits; return how long after that the arm braked."""
    at.swing()
    head = "POST /v1/swing?wait_s=30 HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
    with socket.create_connection(("127.0.0.1", at.plant.port)) as link:
        link.sendall(head.encode())
        while not at.is_moving():
            time.sleep(HEARTBEAT_S * chance.random())
        lost_s = time.monotonic()
    return at.braked_after_s(lost_s)


WAYS = {"silent": lose_holder, "gone": lose_connection}


def swing(context: OperationContext, _request: SwingRequest) -> SwingResult:
    """Move until the client is lost."""
    mover = context.connection.mover
    return SwingResult(outcome=mover.execute(long_motion(mover.state().position_rad)).outcome)


def main() -> None:
    """Serve until a signal."""
    cell, port, stop_port, runs = sys.argv[1:]
    verb = Operation(name="swing", request_model=SwingRequest, result_model=SwingResult, run=swing, summary="Swing")
    options = Options(exposure=Exposure(), port=int(port), stop_port=int(stop_port), runs_dir=Path(runs), warm=False)
    Panelwright(load_cell(Path(cell)), options, operations={"swing": verb}).run()


if __name__ == "__main__":
    main()
