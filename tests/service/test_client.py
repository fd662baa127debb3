"""Stopping from the command line: when the service does not answer, and by Ctrl-C."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from hal.errors import ConfigError, DeviceUnavailable
from service.client import Client
from service.commands.own_cell import run_task
from service.processes.latch import Latch
from service.processes.stop_host import InlineStop, bound_socket


@pytest.fixture
def hung() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two neighbouring ports: one of a service that takes connections and never answers, the next one free."""
    while True:
        service = bound_socket("127.0.0.1", 0)
        try:
            beside = bound_socket("127.0.0.1", service.getsockname()[1] + 1)
            break
        except ConfigError:
            service.close()
    yield service, beside
    service.close()
    beside.close()


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.client.STOP_WAIT_S", 0.3)


def _client_of(service: socket.socket) -> Client:
    return Client(url=f"http://127.0.0.1:{service.getsockname()[1]}")


def test_a_service_that_hangs_does_not_hinder_a_stop(hung: tuple[socket.socket, socket.socket], tmp_path: Path) -> None:
    service, beside = hung
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    stop = InlineStop(latch, beside, ())
    try:
        assert _client_of(service).stop()["is_latched"]
        assert latch.is_set()
    finally:
        stop.close()
        latch.close()


def test_where_nobody_stops_a_person_must(hung: tuple[socket.socket, socket.socket]) -> None:
    service, beside = hung
    beside.close()
    with pytest.raises(DeviceUnavailable, match="nor does a stop process") as refusal:
        _client_of(service).stop()
    assert "hardware stop" in refusal.value.hint


class Interrupted:
    """A client whose person presses Ctrl-C as soon as the task runs."""

    def __init__(self) -> None:
        self.posted: list[str] = []

    def post(self, path: str, _body: Any = None) -> Any:
        self.posted.append(path)
        return {"id": "7", "state": "cancelled"}

    def get(self, _path: str) -> Any:
        raise KeyboardInterrupt


def test_ctrl_c_ends_a_task_on_a_running_service_too(capsys: pytest.CaptureFixture[str]) -> None:
    client = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        run_task(cast("Client", client), "/v1/calibrations", {"what": "tool"})
    assert client.posted == ["/v1/calibrations", "/v1/tasks/7/cancel"]
    assert "the arm stops" in capsys.readouterr().out
