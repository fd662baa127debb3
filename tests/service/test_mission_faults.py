"""If devices fail during a real mission, the arm stops, the task states the cause, and no process remains."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from tests.service.waiting import eventually

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


class Bench:
    """`panelwright serve` on the shipped cell, in separate processes."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        cell = str(ROOT / "cells" / "bench.toml")
        options = ["--cell", cell, "--port", str(self.port), "--stop-port", "0", "--no-console", "--runs", str(folder)]
        self.log = folder / "serve.log"
        with self.log.open("w") as log:
            command = [sys.executable, "-m", "service.cli", "serve", *options]
            self.process = psutil.Popen(command, stdout=log, stderr=log, cwd=ROOT)
        self.client = httpx2.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=60.0, trust_env=False)
        self.runs = folder
        eventually(self._is_ready, timeout_s=300.0)
        self.family = self.process.children(recursive=True)

    def _is_ready(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        try:
            return self.client.get("/readyz").status_code == 200
        except httpx2.TransportError:
            return False

    def begin_mission(self) -> str:
        """Start a mission; return its URL when the arm moves."""
        self.client.post("/v1/stop/reset", json={"seen_count": self.client.get("/v1/stop").json()["count"]})
        url = self.client.post("/v1/missions", json={"file": "demo"}).headers["location"]
        eventually(lambda: self.task(url)["state"] == "running", timeout_s=120.0)
        eventually(lambda: self.task(url)["fraction"] > 0.06, timeout_s=300.0)
        return url

    def task(self, url: str) -> Any:
        return self.client.get(url).json()

    def ended(self, url: str) -> Any:
        eventually(lambda: self.task(url)["state"] in ("succeeded", "failed", "cancelled"), timeout_s=300.0)
        return self.task(url)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(tmp_path_factory.mktemp("runs"))
    yield bench
    for process in [bench.process, *bench.family]:
        if _runs(process):
            process.kill()
    bench.client.close()


def test_recognise_by_range_finds_mushroom_and_wheel_of_a_panel_that_nobody_has_located(bench: Bench) -> None:
    bench.client.post("/v1/stop/reset", json={"seen_count": bench.client.get("/v1/stop").json()["count"]})
    task = bench.ended(bench.client.post("/v1/recognise", json={"use": ["range"]}).headers["location"])
    assert task["state"] == "succeeded", task["problem"]
    answer = task["result"]
    assert [(row["name"], row["found"]) for row in answer["by_surfaces"]] == [("bypass", True), ("emergency", True)]
    assert all(row["off_panel_file_m"] < 0.005 for row in answer["by_surfaces"])
    labels = {surface["label"]: surface["type"] for surface in answer["surfaces"]}
    assert labels[answer["plate"]] == "plane"
    picture = bench.client.get(answer["range_picture"])
    assert picture.headers["content-type"] == "image/png" and picture.content.startswith(b"\x89PNG")


def test_a_device_that_dies_ends_the_mission_with_its_name_and_a_report(bench: Bench) -> None:
    url = bench.begin_mission()
    assert bench.client.post("/v1/devices/wrist_ft/fault", json={"fault": "disconnected"}).status_code == 200
    task = bench.ended(url)
    assert task["state"] == "failed"
    assert "wrist_ft" in task["problem"]["detail"]
    assert task["problem"]["details"]["device"] == "wrist_ft"
    assert task["problem"]["hint"]
    reports = bench.client.get("/v1/missions").json()["missions"]
    report = bench.client.get(reports[0]["json_url"]).json()
    assert report["problem"]["detail"] == task["problem"]["detail"]
    assert report["steps"], "what was done until then is kept"
    bench.client.post("/v1/devices/wrist_ft/fault", json={"fault": None})


def test_a_stop_in_the_middle_ends_the_mission(bench: Bench) -> None:
    url = bench.begin_mission()
    stopped = httpx2.post(bench.client.get("/v1/info").json()["stop_url"], trust_env=False)
    assert stopped.status_code == 200
    task = bench.ended(url)
    assert (task["state"], task["problem"]["type"]) == ("failed", "urn:panelwright:stopped")


def test_killing_the_cell_ends_the_mission_and_its_world(bench: Bench) -> None:
    url = bench.begin_mission()
    cell = next(p for p in bench.client.get("/readyz").json()["processes"] if p["name"] == "cell")
    worlds = psutil.Process(cell["pid"]).children(recursive=True)
    assert worlds, "the simulated world runs below the cell"
    os.kill(cell["pid"], signal.SIGKILL)
    task = bench.ended(url)
    assert task["state"] == "failed"
    assert "unavailable" in task["problem"]["type"]
    eventually(lambda: not [world for world in worlds if _runs(world)])
    assert bench.client.get("/v1/stop").json()["is_latched"]
    eventually(bench._is_ready, timeout_s=300.0)
    assert bench.client.get("/v1/stop").json()["is_latched"], "a restart alone frees nothing"


def test_ctrl_c_in_the_middle_leaves_nothing(bench: Bench) -> None:
    bench.begin_mission()
    family = bench.process.children(recursive=True)
    assert len(family) >= 3, "cell, stop and world"
    os.kill(bench.process.pid, signal.SIGINT)
    bench.process.wait(90)
    eventually(lambda: not [process for process in family if _runs(process)])
    assert "Traceback" not in bench.log.read_text()


def _runs(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
