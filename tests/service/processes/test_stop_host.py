"""The stop works although the process that should set the latch hangs, and ends latched when its supervisor dies."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.child_python import module_command
from hal.errors import MotionRefused
from service.processes.latch import Latch
from service.processes.stop_host import ProcessStop, bound_socket
from tests.service.waiting import eventually


@pytest.fixture
def latch(tmp_path: Path) -> Iterator[Latch]:
    with Latch.create(tmp_path / "latch") as latch:
        latch.reset("test", seen_count=latch.state().count)
        yield latch


@pytest.fixture
def host(latch: Latch, tmp_path: Path) -> Iterator[ProcessStop]:
    host = ProcessStop(latch, tmp_path, None, (), report=lambda _kind, _data: None)
    yield host
    os.kill(_pid(host), signal.SIGCONT)
    host.close()


def test_a_stop_process_that_hangs_keeps_nobody_from_stopping(latch: Latch, host: ProcessStop) -> None:
    os.kill(_pid(host), signal.SIGSTOP)
    assert host.stop("a person").is_latched
    assert latch.is_set()


def test_the_death_of_the_stop_process_latches_the_stop_even_if_nobody_watches_its_heartbeat(
    latch: Latch, host: ProcessStop
) -> None:
    os.kill(_pid(host), signal.SIGKILL)
    eventually(lambda: host.restarts == 1 and host.is_alive())
    assert latch.state().source == "the stop process died"


def test_a_reset_that_the_stop_process_overtook_by_a_stop_is_not_done(
    latch: Latch, host: ProcessStop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop port was asked to stop between the supervisor's line and its answer."""
    count = latch.set("a person").count
    pressed: list[Any] = []

    def press_meanwhile(_seen: int, _within_s: float) -> bool:
        pressed.append(latch.set("another person"))
        return True

    monkeypatch.setattr(host, "_has_changed", press_meanwhile)
    monkeypatch.setattr(host._child, "write_line", lambda _line: True)
    assert not host.reset("test", seen_count=count)
    assert latch.is_set() and pressed


def test_a_reset_that_is_obeyed_too_late_clears_nothing_for_a_moment(
    latch: Latch, host: ProcessStop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each change of the latch raises its count, so that a clear moment in between would show in it."""
    seen = host.stop("a person").count
    os.kill(_pid(host), signal.SIGSTOP)
    monkeypatch.setattr("service.processes.stop_host.RESET_ANSWER_S", 0.05)
    with pytest.raises(MotionRefused, match="did not answer"):
        host.reset("test", seen_count=seen)
    held = latch.state().count
    host._child.write_line("stop the line behind the reset")
    os.kill(_pid(host), signal.SIGCONT)
    eventually(lambda: latch.state().source == "the line behind the reset")
    assert latch.state().count == held + 1


def test_a_stop_process_without_its_supervisor_latches_and_ends(latch: Latch, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        arguments = ["--fd", str(listener.fileno()), "--folder", str(tmp_path)]
        process = subprocess.Popen(
            module_command("service.processes.stop", *arguments),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[listener.fileno()],
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        assert not latch.is_set()
        process.stdin.close()  # as when the process that holds the other end is killed
        eventually(lambda: process.poll() is not None)
        process.stdout.close()
    assert latch.is_set()
    assert latch.state().source == "the service is gone"


def test_answers_do_not_wait_for_the_acknowledgement_of_their_first_packet() -> None:
    """Head and body of an answer are two packets; with Nagle's algorithm each answer took 40 ms longer."""
    with bound_socket("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1


def _pid(host: ProcessStop) -> int:
    assert host.pid is not None
    return host.pid
