"""`isolate = true`: the driver lives in a process of its own, and the cell does not notice until that process dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import psutil
import pytest

from hal.clock import Deadline, WallClock
from hal.config import Cell, load_cell
from hal.errors import ConfigError, DeviceUnavailable
from service.cell import CellRuntime
from tests.service.conftest import WriteCell

NAME = "finger_proximity"


def isolated(cell: Cell) -> Cell:
    cell.file.devices[NAME] = cell.file.devices[NAME].model_copy(update={"isolate": True})
    return cell


@pytest.fixture
def runtime(write_cell: WriteCell) -> Iterator[CellRuntime]:
    cell = isolated(load_cell(write_cell(mode="real")))
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    yield runtime
    runtime.close()


def test_the_driver_works_in_a_process_of_its_own_and_leaves_none_behind(runtime: CellRuntime) -> None:
    device = runtime.objects[NAME]
    (child,) = [p for p in psutil.Process().children() if "multiprocessing.spawn" in " ".join(p.cmdline())]
    deadline = Deadline.after(WallClock(), 5.0)
    assert device.read_distance_m(deadline=deadline).usable(now_s=WallClock().now_s(), max_age_s=5.0, device=NAME)
    assert device.kind == "proximity" and device.health().connected
    os.kill(child.pid, signal.SIGKILL)
    with pytest.raises(DeviceUnavailable, match=NAME) as gone:
        device.read_distance_m(deadline=Deadline.after(WallClock(), 5.0))
    assert "PUT /v1/devices" in gone.value.hint
    runtime.close()
    assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


def test_a_simulated_cell_refuses_it(write_cell: WriteCell) -> None:
    with pytest.raises(ConfigError, match="cannot be isolated"):
        CellRuntime.start(isolated(load_cell(write_cell())), is_latched=lambda: False)
