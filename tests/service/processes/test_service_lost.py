"""A real cell process whose service is killed or suspended in a motion does what the cell file chooses, by itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from service.processes.latch import Latch, StopLevel
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually

BEGUN_RAD = 0.35  # of the first joint, with which the tip has gone further than it goes back
LEAST_BACK_RAD = 0.1
SERVICE = """
import sys
from pathlib import Path
import numpy as np
from hal.config import load_cell
from hal.motion import JointTrajectory
from service.processes.supervisor import Supervisor
cell = load_cell(Path(sys.argv[1]))
supervisor = Supervisor(cell)
supervisor.start()
supervisor.reset("test", seen_count=supervisor.latch.state().count)
print(supervisor.folder, flush=True)
begin = np.array(cell.file.workspace.park_rad)
swing = JointTrajectory(
    name="swing", times_s=np.array([0.0, 12.0]), positions_rad=np.array([begin, begin + [2.0, 0, 0, 0, 0, 0]]),
    velocities_rad_per_s=np.zeros((2, 6)),
)
supervisor.connection.mover.execute(swing)
"""


class Scene:
    """A service that moves the first joint of its arm, and what the arm was told."""

    def __init__(self, service: subprocess.Popen[str], trace: Path, latch: Latch) -> None:
        self.service, self.latch = service, latch
        self._trace = trace
        self.children = psutil.Process(service.pid).children(recursive=True)

    def lines(self) -> list[str]:
        return [line.split()[0] for line in self._trace.read_text().split("\n")[:-1]]

    def path_rad(self) -> list[float]:
        return [float(line) for line in self.lines() if line != "stop"]

    def has_moved(self) -> bool:
        path = self.path_rad()
        return bool(path) and path[-1] > BEGUN_RAD

    def is_switched_off(self) -> bool:
        return self.lines()[-1] == "stop"

    def went_back_rad(self) -> float:
        return max(self.path_rad()) - self.path_rad()[-1]

    def all_ended(self) -> bool:
        return not any(child.is_running() and child.status() != "zombie" for child in self.children)


@contextmanager
def moving(write_cell: WriteCell, tmp_path: Path, service_lost: str) -> Iterator[Scene]:
    """Yield a service in the middle of a motion."""
    trace = tmp_path / "trace"
    cell = write_cell(
        robot=True, mode="real", options={"arm": {"trace": str(trace)}},
        extra=f'[safety]\nservice_lost = "{service_lost}"',
    )  # fmt: skip
    command = [sys.executable, "-P", "-c", SERVICE, str(cell)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        folder = Path(service.stdout.readline().strip())
        with Latch(folder / "latch") as latch:
            scene = Scene(service, trace, latch)
            try:
                eventually(scene.has_moved)
                yield scene
            finally:
                service.kill()
                eventually(scene.all_ended)


@pytest.mark.parametrize(("service_lost", "goes_back"), [("stop", False), ("hold", False), ("retreat", True)])
def test_the_cell_of_a_killed_service_brings_the_arm_to_rest_and_ends(
    write_cell: WriteCell, tmp_path: Path, service_lost: str, goes_back: bool
) -> None:
    with moving(write_cell, tmp_path, service_lost) as scene:
        scene.service.kill()
        eventually(scene.all_ended)
        assert scene.is_switched_off()
        assert scene.latch.state().level is StopLevel.OFF
        check_way_back(scene, goes_back=goes_back)


def test_an_arm_whose_service_is_suspended_goes_back_and_is_switched_off(write_cell: WriteCell, tmp_path: Path) -> None:
    with moving(write_cell, tmp_path, "retreat") as scene:
        os.kill(scene.service.pid, signal.SIGSTOP)
        eventually(scene.is_switched_off)
        assert "the service process is suspended" in scene.latch.state().source
        assert scene.latch.state().level is StopLevel.RETREAT
        check_way_back(scene, goes_back=True)


def test_an_arm_whose_service_is_suspended_is_held(write_cell: WriteCell, tmp_path: Path) -> None:
    with moving(write_cell, tmp_path, "hold") as scene:
        os.kill(scene.service.pid, signal.SIGSTOP)
        eventually(scene.latch.keeps_power)
        eventually(lambda: len(set(scene.lines()[-20:])) == 1)
        assert not scene.is_switched_off(), "set-points hold it where it is"
        check_way_back(scene, goes_back=False)


def check_way_back(scene: Scene, *, goes_back: bool) -> None:
    if goes_back:
        assert LEAST_BACK_RAD < scene.went_back_rad() < BEGUN_RAD
    else:
        assert scene.went_back_rad() == 0.0
