"""Tests of the command line as users run it: real processes, one clear message, no traceback, no orphan process."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from service.commands.demo import judged, reported
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually

SCRIPT = Path(sys.executable).with_name("panelwright")
"""The command that users type; unlike `python -m` it does not put the current folder on the import path."""
OURS = ("drivers", "fusion", "hal", "manipulation", "perception", "service", "simbackend")
PANELWRIGHT = [sys.executable, "-m", "service.cli"]


def _run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PANELWRIGHT, *arguments], capture_output=True, text=True, timeout=240, check=False, cwd=cwd)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _assert_refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    text = done.stdout + done.stderr
    assert done.returncode == 2, text
    assert "Traceback" not in text
    assert "try" in text
    for word in words:
        assert word in text, text


def test_an_unknown_driver_is_one_clear_message(write_cell: WriteCell) -> None:
    path = write_cell(robot=True)
    path.write_text(path.read_text().replace("fake:lights", "fake:lihgts"))
    done = _run("serve", "--cell", str(path), "--port", "0")
    _assert_refused(done, str(path), "devices.panel_lights", "did you mean 'fake:lights'?")


def test_a_misspelt_key_is_one_clear_message(write_cell: WriteCell) -> None:
    path = write_cell(robot=True)
    path.write_text(path.read_text().replace("seed = 3", "sead = 3"))
    _assert_refused(_run("serve", "--cell", str(path)), str(path), "cell.sead", "did you mean 'seed'?")


def test_a_missing_cell_file_is_one_clear_message() -> None:
    _assert_refused(_run("serve", "--cell", "nowhere.toml"), "nowhere.toml", "does not exist")


def test_a_mistyped_name_of_a_shipped_cell_is_told_the_right_one_from_any_folder(tmp_path: Path) -> None:
    done = _run("serve", "--cell", "cells/bnch.toml", cwd=tmp_path)
    _assert_refused(done, "does not exist", "did you mean", "cells/bench.toml")


def test_a_missing_device_is_one_clear_message_of_a_command_that_wants_them_all(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    path = write_cell(robot=True, options={"panel_lights": {"fail": "no answer from 10.0.0.9"}})
    done = _run("demo", "--cell", str(path), "--runs", str(tmp_path / "runs"))
    _assert_refused(done, "panel_lights", "no answer from 10.0.0.9", "plug it in")


def test_a_missing_device_does_not_end_the_service(write_cell: WriteCell, tmp_path: Path) -> None:
    away = {"fail": "no answer from [10.0.0.9]"}
    world = {"child_pid_file": str(tmp_path / "world.pid")}
    served = Served(write_cell(robot=True, options={"finger_proximity": away, "panel_lights": world}), tmp_path)
    try:
        eventually(lambda: "devices connect finger_proximity" in served.log.read_text())
        told = served.log.read_text()
        assert (
            "no answer from [10.0.0.9]\n  lost   panel-pose, recognise" in told
            and "\n  try    plug it in; then" in told
        )
    finally:
        served.process.terminate()
        served.process.wait(90)
        served.client.close()


def test_a_port_in_use_is_one_clear_message(write_cell: WriteCell, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = _run("serve", "--cell", str(write_cell(robot=True)), "--port", port, "--runs", str(tmp_path / "runs"))
        clash = _run("serve", "--cell", str(write_cell(robot=True)), "--port", "0", "--stop-port", port)
    _assert_refused(done, f"port {port}", "--port")
    _assert_refused(clash, f"port {port}", "--stop-port")
    _assert_refused(
        _run("serve", "--cell", str(write_cell(robot=True)), "--port", port, "--stop-port", port), "the stop process"
    )


def test_a_public_address_is_refused_while_there_are_no_keys(write_cell: WriteCell) -> None:
    _assert_refused(_run("serve", "--cell", str(write_cell(robot=True)), "--host", "0.0.0.0"), "0.0.0.0", "ssh -L")  # noqa: S104 - what is refused


def test_no_service_to_talk_to_is_one_clear_message() -> None:
    _assert_refused(_run("task", "list", "--url", "http://127.0.0.1:9"), "127.0.0.1:9", "panelwright serve")


def test_another_python_is_refused_before_anything_is_imported() -> None:
    code = "import sys; sys.version_info = (3, 12, 1); import service.cli; service.cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240, check=False)
    _assert_refused(done, "Python 3.11", "3.12", "make setup")


def test_a_missing_simulator_is_one_clear_message() -> None:
    code = (
        "import sys, importlib.util as u; real = u.find_spec; "
        "u.find_spec = lambda name, *a: None if name == 'pybullet' else real(name, *a); "
        "sys.argv = ['panelwright', 'serve', '--port', '0']; import service.cli; service.cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240, check=False)
    _assert_refused(done, "PyBullet is not installed", "make setup")


def test_files_of_the_user_that_are_called_like_ours_break_nothing(write_cell: WriteCell, tmp_path: Path) -> None:
    for name in OURS:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the user was taken for ours')\n")
    command = [str(SCRIPT), "doctor", "--cell", str(write_cell(robot=True)), "--port", str(_free_port())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "cell process" in done.stdout  # a child process has started and has found its driver


def test_init_copies_a_cell_that_doctor_accepts_and_never_overwrites(tmp_path: Path) -> None:
    done = _run("init", "mine", "--cell", "cells/ur10e.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "panelwright doctor --cell cells/ur10e.toml" in done.stdout
    folder = tmp_path / "mine"
    (folder / "panels" / "bench.toml").write_text("name = 'other'")
    _assert_refused(_run("init", "mine", "--cell", "cells/ur10e.toml", cwd=tmp_path), "exists already")
    checked = _run("doctor", "--no-connect", "--cell", "cells/ur10e.toml", cwd=folder)
    assert checked.returncode == 1  # the command reads the copy instead of the shipped file
    assert "panels/bench.toml" in checked.stdout


@pytest.mark.parametrize("command", [("doctor", "--no-connect"), ("demo",)], ids=["doctor", "reading"])
def test_a_scale_in_degrees_under_a_key_for_radians_is_refused(command: tuple[str, ...], tmp_path: Path) -> None:
    """Read as radians, such a gauge showed 7.88 bar instead of 1.08."""
    assert _run("init", "mine", cwd=tmp_path).returncode == 0
    panel = tmp_path / "mine/panels/bench.toml"
    given = panel.read_text()
    panel.write_text(given.replace("at_min = -2.3562, at_max = 2.3562", "at_min = -135.0, at_max = 135.0", 1))
    assert panel.read_text() != given
    done = _run(*command, "--cell", "cells/bench.toml", cwd=tmp_path / "mine")
    said = " ".join((done.stdout + done.stderr).split())
    assert done.returncode != 0 and "Traceback" not in said
    assert "everything is in order" not in said
    assert "-135 rad is beyond a full turn" in said and "at_min_deg = -135" in said and "at_max_deg = 135" in said
    assert not list(tmp_path.rglob("report.json"))


class Served:
    """`panelwright serve` in a separate process."""

    def __init__(self, cell: Path, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        arguments = ["--cell", str(cell), "--port", str(self.port), "--stop-port", "0", "--no-warm", "--no-console"]
        arguments += ["--runs", str(folder / "runs")]
        self.log = folder / "serve.log"
        with self.log.open("w") as log, _hearing_hangups():
            self.process = psutil.Popen([*PANELWRIGHT, "serve", *arguments], stdout=log, stderr=log)
        self.client = httpx2.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=30.0, trust_env=False)
        eventually(self._is_ready)
        self.family = self.process.children(recursive=True)
        self.world = psutil.Process(int(eventually((folder / "world.pid").read_text)))

    def _is_ready(self) -> bool:
        try:
            return bool(self.client.get("/readyz").status_code == 200)
        except httpx2.TransportError:
            assert self.process.poll() is None, self.log.read_text()
            return False

    def survivors(self) -> list[psutil.Process]:
        return [process for process in [*self.family, self.world] if _runs(process)]


@contextmanager
def _hearing_hangups() -> Iterator[None]:
    """Child processes inherit an ignored SIGHUP, for example if the tests themselves run under `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.fixture
def served_alone(write_cell: WriteCell, tmp_path: Path) -> Iterator[Served]:
    cell = write_cell(robot=True, options={"panel_lights": {"child_pid_file": str(tmp_path / "world.pid")}})
    served = Served(cell, tmp_path)
    yield served
    for process in [served.process, *served.survivors()]:
        if _runs(process):
            process.kill()
    served.client.close()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_no_end_of_the_service_leaves_an_orphan(served_alone: Served, how: signal.Signals) -> None:
    assert len(served_alone.family) >= 2, "a cell and a stop process at least"
    with socket.create_connection(("127.0.0.1", served_alone.port)) as upload:
        upload.sendall(b"POST /v1/echo HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n")
        upload.sendall(b"Content-Length: 100000\r\n\r\n{")
        os.kill(served_alone.process.pid, how)
        served_alone.process.wait(90)
    eventually(lambda: not served_alone.survivors())
    assert "Exception" not in served_alone.log.read_text(), "the upload that was cut is no defect"
    assert "Traceback" not in served_alone.log.read_text()
    assert (how is signal.SIGKILL) is ("processes ended" not in served_alone.log.read_text())


def test_ctrl_c_again_and_again_cuts_nothing_of_the_end_off(served_alone: Served) -> None:
    while _runs(served_alone.process):
        os.kill(served_alone.process.pid, signal.SIGINT)
        with contextlib.suppress(psutil.TimeoutExpired):
            served_alone.process.wait(0.05)
    eventually(lambda: not served_alone.survivors())
    assert "Traceback" not in served_alone.log.read_text()
    assert "processes ended" in served_alone.log.read_text()


def test_ctrl_c_ends_open_streams_too(served_alone: Served) -> None:
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{served_alone.port}/v1/stream", proxy=None, open_timeout=90) as stream:
        stream.recv(timeout=90)
        os.kill(served_alone.process.pid, signal.SIGINT)
        served_alone.process.wait(90)
    eventually(lambda: not served_alone.survivors())


def test_devices_and_tasks_are_shown_on_the_terminal(served_alone: Served) -> None:
    url = ["--url", f"http://127.0.0.1:{served_alone.port}"]
    listed = _run("devices", "list", *url)
    assert "wrist_camera" in listed.stdout
    assert "valid" in listed.stdout
    before = _run("devices", *url, "read", "finger_proximity")
    assert before.returncode == 0, "an address before the command is for it: it went to the usual one"
    lines = _run("devices", "read", "finger_proximity", "--samples", "3", "--jsonl", *url).stdout.splitlines()
    assert len(lines) == 3
    assert '"value": 0.123' in lines[0]
    swapped = _run("devices", "swap", "finger_proximity", "fake:proximity", *url)
    assert "finger_proximity: fake:proximity, valid" in swapped.stdout
    _assert_refused(_run("devices", "swap", "finger_proximity", "fake:lights", *url), "keeps fake:proximity")
    assert "latched" in _run("stop", *url).stdout
    assert "clear" in _run("stop", "--reset", *url).stdout
    assert _run("task", "list", *url).returncode == 0
    _assert_refused(_run("task", "show", "nonsense", *url), "nonsense")


def _runs(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


STUBBORN = """
import sys, time
from pathlib import Path
from hal.config import load_cell
from service.commands.serve import run_to_end
from service.operations import Operation
from service.serve import Options, Panelwright
from tests.service.verbs import EchoRequest, HoldResult

def stubborn(context, request):
    while True:  # computes, and never asks whether it was cancelled
        sum(range(10_000))

operation = Operation(name="stubborn", request_model=EchoRequest, result_model=HoldResult, run=stubborn, summary="Never ends")
options = Options(port=int(sys.argv[2]), stop_port=0, runs_dir=Path(sys.argv[3]), warm=False)
run_to_end(Panelwright(load_cell(Path(sys.argv[1])), options, operations={"stubborn": operation}))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_task_that_never_looks_up_does_not_keep_the_service_alive(
    write_cell: WriteCell, tmp_path: Path, how: signal.Signals
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = [str(write_cell(robot=True)), str(port), str(tmp_path / "runs")]
    process = psutil.Popen([sys.executable, "-c", STUBBORN, *arguments], cwd=Path(__file__).parents[3])
    url = f"http://127.0.0.1:{port}"

    def is_ready() -> bool:
        try:
            return httpx2.get(f"{url}/readyz", trust_env=False, timeout=30).status_code == 200
        except httpx2.TransportError:
            return False

    try:
        eventually(is_ready)
        httpx2.post(f"{url}/v1/stubborn", trust_env=False, timeout=30)
        eventually(lambda: httpx2.get(f"{url}/v1/tasks", trust_env=False).json()["tasks"][0]["state"] == "running")
        family = process.children(recursive=True)
        os.kill(process.pid, how)
        process.wait(60)
        eventually(lambda: not [child for child in family if _runs(child)])
    finally:
        if _runs(process):
            process.kill()


class OneAnswer:
    """Client for which every POST is answered by the same task."""

    def __init__(self, task: dict[str, Any]) -> None:
        self._task = task

    def post(self, _path: str, _body: Any) -> Any:
        return self._task


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        ({"detail": "this cell has no simulated arm", "hint": "use sim:arm"}, "no simulated arm; try: use sim:arm"),
        (None, "no verdict within 30 s; try: see task t1"),
    ],
)
def test_a_demo_that_nobody_can_judge_says_why(problem: dict[str, str] | None, words: str) -> None:
    client: Any = OneAnswer({"id": "t1", "result": None, "problem": problem})
    assert words in judged(client, "m1")


def test_a_demo_names_the_report_of_its_own_mission_only() -> None:
    missions = [{"name": "20260102T000000-t9"}, {"name": "20260101T000000-t1"}]
    assert reported(missions, "t1") == "20260101T000000-t1"
    assert reported(missions, "t2") is None
