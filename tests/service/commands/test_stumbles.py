"""Tests of typical difficulties in a terminal: wrong folders, incomplete addresses, logs, Ctrl-C during the start."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import httpx2
import pytest
import typer
from typer.testing import CliRunner

from hal.errors import ConfigError, DeviceUnavailable, InvalidRequest
from service.cli import _app
from service.client import Client
from service.commands import demo, devices, tasks, teach
from service.commands import serve as serving
from service.commands.common import read_cell
from service.errors import of_file
from service.operations import mission
from service.processes.stop_host import bound_socket
from service.report.record import MissionRecord
from service.serve import Panelwright
from tests.service.conftest import WriteCell


def test_a_folder_that_is_not_there_is_one_clear_message(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    import service.cli

    def command() -> None:
        (tmp_path / "nowhere" / "x.png").write_bytes(b"")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(service.cli, "_app", lambda: command)
        patched.setattr("service.commands.shutdown.leave", _leave)
        with pytest.raises(SystemExit, match="2"):
            service.cli.main()
    told = capsys.readouterr().err
    assert str(tmp_path / "nowhere" / "x.png") in told
    assert "try" in told


def test_a_name_that_is_like_another_by_its_ending_alone_is_not_proposed(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "bench.toml").touch()
    for name, near in (("nope.toml", "give the path"), ("bnech.toml", "bench.toml")):
        with pytest.raises(ConfigError) as refused:
            read_cell(tmp_path / name, None)
        assert near in refused.value.hint


def test_the_version_is_told() -> None:
    told = CliRunner().invoke(_app(), ["--version"])
    assert told.exit_code == 0
    assert told.output.startswith("panelwright ")


def test_a_full_disk_is_told_and_a_fault_of_ours_is_not_hidden() -> None:
    full = of_file(OSError(errno.ENOSPC, "No space left on device"))
    assert full is not None
    assert "No space left" in full.what
    assert of_file(OSError("a defect")) is None


def test_an_address_is_taken_as_curl_takes_it(served: Panelwright) -> None:
    assert Client(url=f"localhost:{served.port}").get("/readyz")["is_ready"]


@pytest.mark.parametrize("url", ["ftp://localhost:8460", "http://localhost:none", "http://", ""])
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="not the address"):
        Client(url=url).get("/readyz")


class Stranger(BaseHTTPRequestHandler):
    """Web server of another program; one of its pages ends in the middle of the answer."""

    def do_GET(self) -> None:
        self.send_response(200)
        if self.path == "/cut-off":
            self.send_header("Content-Length", "1000")
        self.end_headers()
        self.wfile.write(b"<h1>hello</h1>")

    def log_message(self, format: str, *args: object) -> None:
        """Do not log."""


@pytest.fixture
def stranger() -> Iterator[str]:
    server = HTTPServer(("127.0.0.1", 0), Stranger)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def test_another_program_on_that_port_is_refused(stranger: str) -> None:
    with pytest.raises(ConfigError, match="another program answers"):
        Client(url=stranger).get("/v1/devices")


def test_an_answer_that_ends_in_its_middle_is_a_lost_service(stranger: str) -> None:
    with pytest.raises(DeviceUnavailable, match="without sending complete message body"):
        Client(url=stranger).get("/cut-off")


def test_devices_of_the_stop_port_are_no_empty_table(served: Panelwright) -> None:
    done = CliRunner().invoke(devices.app, ["--url", f"http://127.0.0.1:{served.stop_port}"])
    assert done.exit_code != 0


def test_a_picture_without_a_service_is_refused_rather_than_forgotten(tmp_path: Path) -> None:
    asked = ["read", "wrist_camera", "--cell", "cells/bench.toml", "--save", str(tmp_path / "x.png")]
    done = CliRunner().invoke(devices.app, asked)
    assert isinstance(done.exception, ConfigError)


@pytest.mark.parametrize("name", ["x.jpg", "x", "x.npz.gz"])
def test_a_picture_is_not_written_under_the_suffix_of_something_else(
    served: Panelwright, tmp_path: Path, name: str
) -> None:
    done = CliRunner().invoke(
        devices.app, ["read", "wrist_camera", "--url", served.url, "--save", str(tmp_path / name)]
    )
    assert isinstance(done.exception, InvalidRequest) and ".png, .npz" in done.exception.hint
    assert not list(tmp_path.iterdir())


def test_what_is_saved_is_what_the_suffix_says(served: Panelwright, tmp_path: Path) -> None:
    for name, head in (("x.PNG", b"\x89PNG"), ("x.npz", b"PK")):
        words = ["read", "wrist_camera", "--url", served.url, "--save", str(tmp_path / name)]
        assert CliRunner().invoke(devices.app, words).exit_code == 0
        assert (tmp_path / name).read_bytes().startswith(head)


def test_a_folder_that_is_not_there_is_said_in_words(served: Panelwright, tmp_path: Path) -> None:
    words = ["read", "wrist_camera", "--url", served.url, "--save", str(tmp_path / "away" / "x.png")]
    done = CliRunner().invoke(devices.app, words)
    assert isinstance(done.exception, InvalidRequest) and "cannot be written: No such file" in done.exception.what


def test_a_log_of_watching_has_every_look(served: Panelwright) -> None:
    done = CliRunner().invoke(devices.app, ["watch", "--url", served.url, "--count", "3", "--period-s", "0.1"])
    assert done.output.count("finger_proximity") == 3, done.output


def test_the_doctor_leaves_the_devices_to_a_service_that_runs(served: Panelwright) -> None:
    words = ["doctor", "--cell", str(served.service.cell.path), "--port", str(served.port)]
    done = CliRunner().invoke(_app(), words)
    told = " ".join(done.output.split())
    assert f"panelwright serves cell {served.service.cell.name} there" in told
    assert "wrong port" not in told and " answer" not in told


def test_watching_nobody_ends_at_once() -> None:
    with bound_socket("127.0.0.1", 0) as silent:
        nobody = f"http://127.0.0.1:{silent.getsockname()[1]}"
    done = CliRunner().invoke(devices.app, ["watch", "--url", nobody, "--count", "2", "--period-s", "0.1"])
    assert isinstance(done.exception, DeviceUnavailable)


def test_a_task_watched_late_has_no_negative_times(served: Panelwright, monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client(url=served.url)
    task = client.post("/v1/echo?wait_s=30", {"text": "hello"})
    monkeypatch.setattr(tasks.time, "time", lambda: task["ended_s"] + 100.0)
    with tasks.console.capture() as seen:
        tasks.follow(client, task["id"])
    assert "%" in seen.get()
    assert "-" not in seen.get()


def test_the_example_of_a_plate_is_in_metres() -> None:
    app = typer.Typer()
    app.command()(teach.teach)
    done = CliRunner().invoke(app, ["x.png", "--plate", "0.6"])
    assert isinstance(done.exception, InvalidRequest)
    assert done.exception.hint.endswith("0.60,0.40")


def test_nothing_is_called_ready_that_ends_already(monkeypatch: pytest.MonkeyPatch, served: Panelwright) -> None:
    monkeypatch.setattr(Panelwright, "is_ending", property(lambda _self: True))
    with serving.console.capture() as seen:
        serving._announce(served)
    assert seen.get() == ""


def test_a_demo_that_is_broken_off_names_the_report_of_what_it_measured(tmp_path: Path) -> None:
    for name in ("before", "now"):
        (tmp_path / name).mkdir()
    (tmp_path / "before" / "report.html").write_text("")
    before = demo.reports(tmp_path)
    (tmp_path / "now" / "report.html").write_text("")
    os.utime(tmp_path / "now" / "report.html", (0.0, 0.0))  # as if the machine's clock was set back meanwhile
    with demo.console.capture() as seen:
        demo._tell_what_is_left(tmp_path, before)
    assert str(tmp_path / "now") in seen.get()
    assert str(tmp_path / "before") not in seen.get()


def test_a_mount_on_a_frame_that_is_not_there_is_refused_before_anything_starts(write_cell: WriteCell) -> None:
    path = write_cell(robot=True)
    path.write_text(path.read_text().replace('parent = "flange"', 'parent = "flang"', 1))
    with pytest.raises(ConfigError, match=r"mount.parent: no frame called 'flang'"):
        read_cell(path, None)


def test_an_image_for_which_there_is_no_room_leaves_nothing_and_says_so(
    client: httpx2.Client,
    served: Panelwright,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fill(path: Path, data: bytes) -> int:
        with path.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    picture = client.get("/v1/devices/wrist_camera/reading?format=png").content
    with monkeypatch.context() as full:
        full.setattr(Path, "write_bytes", fill)
        answer = client.post("/v1/images", content=picture, headers={"Content-Type": "image/png"})
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:panelwright:file-fault")
    assert not list(served.service.runs_dir.rglob("*.part"))
    assert "No space left" in caplog.text
    assert "Traceback" not in caplog.text, "a full disk is no defect of ours"


def test_a_mission_whose_report_finds_no_room_keeps_its_result(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fill(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(mission, "write_report", fill)
    record = MissionRecord(mission="m", cell="c", panel="p", mode="sim", seed=1, now_s=lambda: 0.0)
    assert not mission._report(record, tmp_path)


def _leave(code: int) -> None:
    raise SystemExit(code)
