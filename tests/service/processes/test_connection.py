"""The service's connection to a cell process has one proxy per thread, and none outlives its thread."""

from __future__ import annotations

import threading
import weakref
from pathlib import Path

import pytest

from hal.config import load_cell
from hal.errors import DeviceUnavailable
from service.processes.connection import RemoteConnection

CELL = load_cell(Path(__file__).parents[3] / "cells" / "bench.toml")


class Wire:
    """Replacement of a proxy that can only be closed."""

    is_open = True

    def disconnect(self) -> None:
        self.is_open = False


def test_the_proxies_of_a_thread_go_with_it() -> None:
    made: list[weakref.ref[Wire]] = []

    def connect(_name: str) -> Wire:
        made.append(weakref.ref(wire := Wire()))
        return wire

    connection = RemoteConnection(CELL)
    connection.attach(connect)
    for _ in range(3):
        thread = threading.Thread(target=lambda: connection.device("arm"))
        thread.start()
        thread.join(10.0)
    assert [wire() for wire in made] == [None] * 3
    assert connection.device("arm") is connection.device("arm") is made[-1]()


def test_a_cell_that_has_gone_takes_its_proxies_along() -> None:
    connection = RemoteConnection(CELL)
    connection.attach(lambda _name: Wire())
    wire = connection.device("arm")
    connection.detach()
    assert not wire.is_open
    with pytest.raises(DeviceUnavailable, match="not running"):
        connection.device("arm")
    connection.attach(lambda _name: Wire())
    assert connection.device("arm").is_open
