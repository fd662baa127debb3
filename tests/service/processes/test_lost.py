"""A process of the cell that dies, hangs or is held by a debugger is noticed, named and started again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from hal.config import load_cell
from hal.errors import MotionRefused
from service.processes.latch import Latch
from service.processes.runtime_folder import RuntimeFolder, clear_abandoned
from service.processes.stop_desk import Records
from service.processes.supervisor import ProcessHealth, Supervisor
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually

SOON_S = 30.0  # a busy machine may need this long; without the watch it never happens
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


class Scene:
    """A running supervisor, and what it recorded."""

    def __init__(self, cell: Path) -> None:
        self.events: list[tuple[str, dict[str, object]]] = []
        self.supervisor = Supervisor(
            load_cell(cell), records=Records(note=lambda kind, data: self.events.append((kind, data)))
        )
        self.supervisor.start()

    def process(self, name: str) -> ProcessHealth:
        return next(process for process in self.supervisor.processes() if process.name == name)

    def pid(self, name: str) -> int:
        pid = self.process(name).pid
        assert pid is not None
        return pid

    def told(self, kind: str) -> dict[str, object]:
        return eventually(lambda: next((data for name, data in self.events if name == kind), None), timeout_s=SOON_S)

    def is_latched_by(self, text: str) -> bool:
        return self.supervisor.latch.is_set() and text in self.supervisor.latch.state().source

    def reset(self) -> None:
        self.supervisor.reset("test", seen_count=self.supervisor.latch.state().count)

    def is_clear_by_reset(self) -> bool:
        """Reset; a loss latches the stop twice, and a reset between the two is rightly refused."""
        try:
            self.reset()
        except MotionRefused as error:
            if "pressed again" not in error.what:
                raise
        return not self.supervisor.latch.is_set()


@pytest.fixture
def scene(write_cell: WriteCell, tmp_path: Path) -> Iterator[Scene]:
    running = Scene(write_cell(options={"panel_lights": {"child_pid_file": str(tmp_path / "world.pid")}}))
    yield running
    running.supervisor.close()


def test_the_processes_share_the_session_of_the_service_and_have_groups_of_their_own(scene: Scene) -> None:
    pids = [scene.pid("cell"), scene.pid("stop")]
    assert {os.getsid(pid) for pid in pids} == {os.getsid(0)}
    assert [os.getpgid(pid) for pid in pids] == pids


def test_a_suspended_stop_process_latches_the_stop_and_is_replaced(scene: Scene) -> None:
    first = scene.pid("stop")
    os.kill(first, signal.SIGSTOP)
    eventually(lambda: scene.is_latched_by("the stop process is suspended"), timeout_s=SOON_S)
    assert "suspended" in str(scene.told("stop-process-lost")["why"])
    eventually(lambda: scene.pid("stop") != first and scene.process("stop").is_alive, timeout_s=SOON_S)
    assert scene.process("stop").restarts == 1
    assert scene.supervisor.latch.is_set(), "a restart alone must not free the arm"
    scene.reset()
    assert not scene.supervisor.latch.is_set()


def test_a_reset_waits_for_a_stop_process_that_pauses_before_its_next_start(scene: Scene) -> None:
    """The second of two short lives in a row is followed by a pause, in which resets were refused."""
    for kills in (1, 2):
        first = scene.pid("stop")
        os.kill(first, signal.SIGKILL)
        eventually(lambda: scene.is_latched_by("the stop process"), timeout_s=SOON_S)
        eventually(scene.is_clear_by_reset, timeout_s=SOON_S)
        assert scene.process("stop").restarts == kills


def test_resets_that_wait_for_a_suspended_stop_process_delay_no_stop(scene: Scene) -> None:
    seen = scene.supervisor.stop("test").count
    os.kill(scene.pid("stop"), signal.SIGSTOP)
    with ThreadPoolExecutor(5) as pool:
        resets = [pool.submit(scene.supervisor.reset, "test", seen_count=seen) for _ in range(4)]
        stopped = pool.submit(scene.supervisor.stop, "a person").result(4.0)
        assert stopped.is_latched
        for reset in resets:
            assert isinstance(reset.exception(), MotionRefused)
    assert scene.supervisor.latch.is_set()


def test_a_suspended_cell_is_latched_by_name_and_replaced(scene: Scene) -> None:
    first = scene.pid("cell")
    os.kill(first, signal.SIGSTOP)
    eventually(lambda: scene.is_latched_by("the cell process is suspended"), timeout_s=SOON_S)
    assert "suspended" in str(scene.told("cell-down")["why"])
    eventually(lambda: scene.supervisor.is_ready and scene.pid("cell") != first, timeout_s=SOON_S)
    assert scene.supervisor.latch.is_set()


def test_a_cell_that_goes_on_after_a_moment_is_ready_again_and_stays_stopped(scene: Scene) -> None:
    pid = scene.pid("cell")
    os.kill(pid, signal.SIGSTOP)
    eventually(lambda: scene.is_latched_by("the cell process is suspended"), timeout_s=SOON_S)
    os.kill(pid, signal.SIGCONT)
    eventually(lambda: scene.supervisor.is_ready, timeout_s=SOON_S)
    assert scene.pid("cell") == pid and scene.supervisor.latch.is_set()


def test_a_dead_world_ends_its_cell_which_comes_back_with_a_new_one(scene: Scene, tmp_path: Path) -> None:
    world = int(eventually((tmp_path / "world.pid").read_text))
    os.kill(world, signal.SIGKILL)
    assert scene.told("cell-down")["why"] == "the fake world has ended"
    eventually(lambda: scene.supervisor.is_ready, timeout_s=SOON_S)
    assert scene.supervisor.latch.is_set()
    assert eventually(lambda: (tmp_path / "world.pid").read_text() not in ("", str(world)), timeout_s=SOON_S)


def test_a_suspended_service_is_stopped_and_its_folder_is_cleared_after_its_death(write_cell: WriteCell) -> None:
    command = [sys.executable, "-P", "-c", SERVICE, str(write_cell())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        folder = Path(service.stdout.readline().strip())
        children = psutil.Process(service.pid).children(recursive=True)
        with Latch(folder / "latch") as latch:
            assert not latch.is_set()
            os.kill(service.pid, signal.SIGSTOP)
            eventually(latch.is_set, timeout_s=SOON_S)
            assert latch.state().source == "the service process is suspended by a signal or a debugger"
        clear_abandoned(folder.parent)
        assert folder.exists(), "it still belongs to a process"
        service.kill()
    eventually(lambda: not any(child.is_running() and child.status() != "zombie" for child in children))
    RuntimeFolder().close()
    assert not folder.exists()


def test_two_services_keep_their_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    strange = tmp_path / "panelwright-of-something-else"
    strange.mkdir()
    first, second = RuntimeFolder(), RuntimeFolder()
    assert first.path.is_dir() and second.path.is_dir() and strange.is_dir()
    first.close()
    second.close()
    assert not first.path.exists() and not second.path.exists()


def test_a_cell_without_a_stop_process_counts_as_stopped(tmp_path: Path) -> None:
    from service.processes.beat import Beat
    from service.processes.child import Lifeline
    from service.processes.vigil import Vigil

    lifeline = Lifeline.__new__(Lifeline)  # not used: nothing that the cell needs is lost
    vigil = Vigil(tmp_path, lifeline, silence_s=0.0)
    vigil.look()
    assert not vigil.is_alone
    Beat(tmp_path, "stop").beat()
    pause = threading.Event()
    eventually(lambda: (vigil.look(), pause.wait(0.001), vigil.is_alone)[2])
