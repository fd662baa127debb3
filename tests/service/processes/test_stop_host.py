"""The stop works although the process that should set the latch hangs, and ends latched when its supervisor dies."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from hal.child_python import module_command
from hal.errors import MotionRefused
from hal.priorities import Priority, take_priority
from manipulation.control.way_back import LONGEST_S
from service.processes import cell, stop
from service.processes.beat import Beat, every_beat
from service.processes.latch import UNREADABLE, Latch, StopLevel
from service.processes.stop import StopServer
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


def test_the_stop_process_is_real_time_where_that_is_allowed(host: ProcessStop) -> None:
    with ThreadPoolExecutor(1) as other:
        wanted = other.submit(lambda: take_priority(Priority.STOP) or os.sched_getscheduler(0)).result()
    eventually(lambda: os.sched_getscheduler(_pid(host)) == wanted)


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
    monkeypatch.setattr("service.processes.stop_host.STOP_ANSWER_S", 60.0)  # so that only the process answers
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


@contextlib.contextmanager
def _orphan(latch: Latch, folder: Path, service_lost: str) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """Yield a stop process whose supervisor has ended, and its port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        arguments = ["--fd", str(listener.fileno()), "--folder", str(folder), "--service-lost", service_lost]
        process = subprocess.Popen(
            module_command("service.processes.stop", *arguments),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[listener.fileno()],
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        assert not latch.is_set()
        process.stdin.close()  # as when the process that holds the other end is killed
        yield process, listener
        process.stdout.close()


@pytest.mark.parametrize("service_lost", ["hold", "stop"])
def test_a_stop_process_without_its_supervisor_latches_and_ends(
    latch: Latch, tmp_path: Path, service_lost: str
) -> None:
    with _orphan(latch, tmp_path, service_lost) as (process, _):
        eventually(lambda: process.poll() is not None)
    assert latch.is_set()
    assert (latch.state().source, latch.state().level) == ("the service is gone", StopLevel.OFF)


def test_an_arm_that_goes_back_without_a_service_can_be_stopped(latch: Latch, tmp_path: Path) -> None:
    with _orphan(latch, tmp_path, "retreat") as (process, listener):
        eventually(latch.goes_back)
        with socket.create_connection(listener.getsockname()) as person:
            person.sendall(b"POST /v1/stop HTTP/1.1\r\n\r\n")
            assert person.recv(100).startswith(b"HTTP/1.1 200")
        assert latch.has(StopLevel.OFF)
        eventually(lambda: process.poll() is not None)


def test_the_stop_process_of_an_arm_that_goes_back_ends_with_its_cell(latch: Latch, tmp_path: Path) -> None:
    cell = Beat(tmp_path, "cell")
    ended = every_beat(cell.beat, name="cell")
    with _orphan(latch, tmp_path, "retreat") as (process, _):
        eventually(latch.goes_back)
        assert process.poll() is None
        ended.set()  # no thread of this process gives its heartbeat any more
        eventually(lambda: process.poll() is not None)
    assert latch.state().level is StopLevel.OFF


def test_a_stop_process_waits_longer_for_a_way_back_than_one_takes() -> None:
    assert LONGEST_S < cell.WAY_BACK_S < cell.WAY_BACK_S + cell.CLOSE_TIMEOUT_S < stop.WAY_BACK_S


def test_answers_do_not_wait_for_the_acknowledgement_of_their_first_packet() -> None:
    """Head and body of an answer are two packets; with Nagle's algorithm each answer took 40 ms longer."""
    with bound_socket("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1


def _pid(host: ProcessStop) -> int:
    assert host.pid is not None
    return host.pid


@pytest.mark.parametrize("unreadable", [1, 2, 3])
def test_a_writer_that_loses_its_processor_in_mid_write_refuses_no_reset_and_acknowledges_no_stop_early(
    unreadable: int, latch: Latch, host: ProcessStop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record that could not be read counted as a change: resets that were done were said to be refused."""
    # The stop process may start slowly. A stop that gave it up would be counted here, and once more when it is ready.
    monkeypatch.setattr("service.processes.stop_host.STOP_ANSWER_S", 60.0)
    read, write, mid_write = latch.state, host._child.write_line, [True] * unreadable
    count = host.stop("a person").count

    def tell(line: str) -> bool:
        mid_write.extend([True] * unreadable)
        return write(line)

    monkeypatch.setattr(host._child, "write_line", tell)
    monkeypatch.setattr(latch, "state", lambda: UNREADABLE if mid_write and mid_write.pop() else read())
    assert host.reset("test", seen_count=count)
    assert host.stop("another person").source == "another person"


def test_a_latch_whose_writer_hangs_in_mid_write_is_set_directly(
    latch: Latch, host: ProcessStop, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_here: list[str] = []
    os.kill(_pid(host), signal.SIGSTOP)
    monkeypatch.setattr("service.processes.stop_host.STOP_ANSWER_S", 60.0)  # so that a stop that waits times out
    monkeypatch.setattr(latch, "state", lambda: UNREADABLE)
    monkeypatch.setattr(latch, "set", lambda source, _level: set_here.append(source))
    host.stop("a person")
    assert set_here == ["a person"]


def test_a_stop_port_that_ends_leaves_no_traceback_of_an_open_connection(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    client = socket.create_connection(listener.getsockname())

    async def serve_until_connected() -> None:
        await StopServer(Latch.create(tmp_path / "latch")).start(listener)
        for _ in range(1000):
            if any("_serve" in repr(task) for task in asyncio.all_tasks()):
                return
            await asyncio.sleep(0)
        raise AssertionError("no connection was accepted")

    asyncio.run(serve_until_connected())
    client.close()
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
