"""A cell process may begin before its service has read the cell file."""

from __future__ import annotations

import psutil
import pytest

from hal.config import load_cell
from hal.errors import DeviceUnavailable
from service.processes.early_cell import EarlyCell
from service.processes.supervisor import Supervisor
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually


def test_the_process_that_runs_already_becomes_the_cell_and_only_the_first_one(write_cell: WriteCell) -> None:
    early = EarlyCell()
    supervisor = Supervisor(load_cell(write_cell()))
    supervisor.begin_with(early)
    try:
        supervisor.start()
        assert supervisor.processes()[0].pid == early.child.pid
        early.child.kill()
        eventually(lambda: supervisor.is_ready and supervisor.processes()[0].restarts == 1, timeout_s=30.0)
        assert supervisor.processes()[0].pid != early.child.pid
    finally:
        supervisor.close()


def test_a_process_that_ended_before_its_order_is_told(write_cell: WriteCell) -> None:
    early = EarlyCell()
    early.child.kill()
    supervisor = Supervisor(load_cell(write_cell()))
    supervisor.begin_with(early)
    try:
        with pytest.raises(DeviceUnavailable, match="ended with code"):
            supervisor.start()
    finally:
        supervisor.close()


@pytest.mark.parametrize("has_owner", [True, False])
def test_a_service_that_does_not_start_leaves_neither_process_nor_folder(
    write_cell: WriteCell, has_owner: bool
) -> None:
    early = EarlyCell()
    if has_owner:
        supervisor = Supervisor(load_cell(write_cell()))
        supervisor.begin_with(early)
        supervisor.close()
    else:
        early.close()
    assert not psutil.pid_exists(early.child.pid)
    assert not early.folder.path.exists()
