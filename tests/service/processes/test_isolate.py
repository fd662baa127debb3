"""With `isolate = true` the driver runs in its own process, which makes no difference until that process dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from hal.clock import Deadline, WallClock
from hal.config import Cell, load_cell
from hal.errors import ConfigError, DeviceUnavailable
from hal.host import connect
from hal.isolated import IsolatedDevice
from hal.registry import Context
from service.processes.cell import CellRuntime
from service.processes.cell_lines import note_from_line, note_to_line
from service.processes.stop_desk import Records
from service.processes.supervisor import Supervisor
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually

NAME = "finger_proximity"
Start = Callable[..., IsolatedDevice]
Notes = list[tuple[str, dict[str, Any]]]


def isolated(cell: Cell, name: str = NAME) -> Cell:
    cell.file.devices[name] = cell.file.devices[name].model_copy(update={"isolate": True})
    return cell


def read(device: Any) -> Any:
    return device.read_distance_m(deadline=Deadline.after(WallClock(), 20.0))


def children() -> list[psutil.Process]:
    started = psutil.Process().children(recursive=True)
    return [p for p in started if p.status() != psutil.STATUS_ZOMBIE and "spawn_main" in " ".join(p.cmdline())]


@pytest.fixture
def trouble(tmp_path: Path) -> Path:
    return tmp_path / "trouble"


@pytest.fixture
def start(trouble: Path, notes: Notes) -> Iterator[Start]:
    started: list[IsolatedDevice] = []

    def begin(kind: str = "proximity", **how: int) -> IsolatedDevice:
        def report(what: str, data: dict[str, Any]) -> None:
            notes.append((what, data))

        options = {"trouble": str(trouble)}
        device = IsolatedDevice(Context(name=NAME), f"fake:{kind}", options, report=report, pause_s=0.01, **how)
        started.append(device)
        return device

    yield begin
    for device in started:
        device.close()


@pytest.fixture
def notes() -> Notes:
    return []


def test_a_driver_that_crashes_says_so_and_is_started_again_until_it_is_closed(
    start: Start, trouble: Path, notes: Notes
) -> None:
    device = start()
    assert read(device).value == 0.123
    assert device.kind == "proximity"
    assert device.health().connected
    trouble.write_text("crash")
    with pytest.raises(DeviceUnavailable, match=NAME) as gone:
        read(device)  # the read itself crashes the driver, inside a library in C
    assert "automatically" in gone.value.hint
    eventually(lambda: "SIGSEGV" in device.health().detail)
    with pytest.raises(DeviceUnavailable, match=r"fake:proximity, has crashed \(SIGSEGV\)"):
        read(device)
    trouble.write_text("away")  # like an unplugged device: not a crash, so it is retried without limit
    eventually(lambda: "not on its port" in device.health().detail)
    trouble.unlink()
    eventually(lambda: device.health().connected)
    assert read(device).value == 0.123
    assert device.health().reconnects == 1
    down = {"device": NAME, "driver": "fake:proximity", "exit": "SIGSEGV"}
    assert notes == [("driver-down", down), ("driver-restarted", {"device": NAME, "restarts": 1})]
    children()[0].send_signal(signal.SIGKILL)
    eventually(lambda: not device.health().connected)
    device.close()
    device.close()
    assert children() == []
    with pytest.raises(DeviceUnavailable, match="is closed"):
        read(device)


def test_a_driver_that_crashes_too_often_stays_down(start: Start, trouble: Path, notes: Notes) -> None:
    device = start(max_restarts=0)
    trouble.write_text("crash")
    with pytest.raises(DeviceUnavailable):
        read(device)
    eventually(lambda: notes and notes[-1][0] == "driver-stays-down")
    with pytest.raises(DeviceUnavailable, match="1 crashes within 60 s, so it is not restarted again") as down:
        read(device)
    assert f"panelwright devices connect {NAME}" in down.value.hint
    assert children() == []


def test_a_driver_that_dies_before_it_is_reached_counts_as_a_crash_and_leaves_nothing(
    start: Start, notes: Notes, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = start(max_restarts=1)
    folders: list[Path] = []

    def connect_too_late(address: str, *args: Any, **how: Any) -> Any:
        folders.append(Path(address).parent)
        children()[0].kill()
        eventually(lambda: children() == [])
        return connect(address, *args, **how)

    monkeypatch.setattr("hal.isolated.connect", connect_too_late)
    children()[0].kill()
    eventually(lambda: notes and notes[-1][0] == "driver-stays-down")
    with pytest.raises(DeviceUnavailable, match="2 crashes within 60 s"):
        read(device)
    assert len(folders) == 1
    assert not folders[0].exists()


def test_a_gripper_is_left_to_a_person(start: Start, notes: Notes) -> None:
    device = start("gripper")
    children()[0].send_signal(signal.SIGKILL)
    eventually(lambda: notes and notes[-1][0] == "driver-stays-down")
    with pytest.raises(DeviceUnavailable, match="jaws may move"):
        device.read_state(deadline=Deadline.after(WallClock(), 5.0))
    assert children() == []


def test_the_crash_is_reported_through_the_cell_process_and_the_cell_lives_on(write_cell: WriteCell) -> None:
    path = write_cell(mode="real")
    path.write_text(path.read_text().replace('driver = "fake:proximity"', 'driver = "fake:proximity"\nisolate = true'))
    notes: list[str] = []
    supervisor = Supervisor(load_cell(path), records=Records(note=lambda kind, _data: notes.append(kind)))
    try:
        supervisor.start()
        device = supervisor.connection.device(NAME)
        assert read(device).value == 0.123
        (child,) = children()
        os.kill(child.pid, signal.SIGSEGV)
        eventually(lambda: "driver-restarted" in notes)
        assert read(device).value == 0.123
        assert "cell-down" not in notes
    finally:
        supervisor.close()
    assert children() == []


def test_what_the_cell_process_notes_arrives_whole() -> None:
    note = ("driver-down", {"device": "a", "exit": "SIGSEGV"})
    assert note_from_line(note_to_line(*note)) == note
    assert note_from_line("ready") is None


def test_a_simulated_cell_refuses_it(write_cell: WriteCell) -> None:
    with pytest.raises(ConfigError, match="cannot be isolated"):
        CellRuntime.start(isolated(load_cell(write_cell())), is_latched=lambda: False)
