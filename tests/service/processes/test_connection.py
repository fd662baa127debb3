"""The service's connection to a cell process has one proxy per device, which goes with the process."""

from __future__ import annotations

import threading
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


def test_all_threads_share_the_proxy_of_a_device() -> None:
    made: list[Wire] = []
    got: list[Wire] = []
    both = threading.Barrier(2)

    def connect(_name: str) -> Wire:
        both.wait(30.0)  # two threads that connect at the same time
        made.append(wire := Wire())
        return wire

    connection = RemoteConnection(CELL)
    connection.attach(connect)
    threads = [threading.Thread(target=lambda: got.append(connection.device("arm"))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30.0)
    assert got[0] is got[1] is connection.device("arm")
    assert sorted(wire.is_open for wire in made) == [False, True]


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
