"""The processes of a cell start and end together, and the latch outlives them."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import psutil
import pytest

from hal.clock import Deadline
from hal.config import load_cell
from hal.devices import DeviceKind
from hal.errors import CellError, ConfigError, DeviceUnavailable, InvalidRequest, MotionRefused, Unsupported
from service.processes.cell import CellRuntime, gathered
from service.processes.latch import Latch
from service.processes.stop_desk import Records
from service.processes.supervisor import Supervisor
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually


@pytest.mark.parametrize("inline", [True, False])
def test_devices_are_the_same_inline_and_across_processes(write_cell: WriteCell, inline: bool) -> None:
    supervisor = Supervisor(load_cell(write_cell()), inline=inline)
    try:
        supervisor.start()
        connection = supervisor.connection
        deadline = Deadline.after(connection.clock, 1.0)
        assert connection.device("finger_proximity").read_distance_m(deadline=deadline).value == 0.123
        image = connection.device("wrist_camera").read_image(deadline=deadline).value
        assert image.pixels.shape == (48, 64, 3)
        assert list(connection.devices_of(DeviceKind.LIGHTS)) == ["panel_lights"]
        assert not supervisor.latch.is_set()
        with pytest.raises(InvalidRequest, match="wrist_camra") as caught:
            connection.device("wrist_camra")
        assert "wrist_camera" in caught.value.hint
        with pytest.raises(Unsupported):
            _ = connection.mover
    finally:
        supervisor.close()


@pytest.mark.parametrize("inline", [True, False])
def test_all_faults_of_connecting_come_in_one_error(write_cell: WriteCell, inline: bool) -> None:
    path = write_cell(
        options={"panel_lights": {"fail": "no answer from 10.0.0.9"}, "wrist_camera": {"crash_at_connect": True}}
    )
    supervisor = Supervisor(load_cell(path), inline=inline)
    try:
        with pytest.raises(DeviceUnavailable, match="2 of the 4") as caught:
            supervisor.start()
    finally:
        supervisor.close()
    text = caught.value.for_people()
    assert "no answer from 10.0.0.9" in text
    assert "planted defect" in text
    assert "Traceback" not in text


def test_what_devices_share_is_said_once_and_faults_of_their_own_by_name(write_cell: WriteCell) -> None:
    cell = load_cell(write_cell())
    shared = {name: ConfigError(f"c.toml: devices.{name}: no such arm", hint="t3") for name in ("arm", "gripper")}
    assert gathered(shared, total=4, cell=cell).what == "c.toml: no such arm"
    own: dict[str, CellError] = {name: DeviceUnavailable("no answer", hint="plug it in") for name in ("arm", "gripper")}
    all_of_them = gathered(own, total=4, cell=cell)
    assert set(all_of_them.details) == {"arm", "gripper"}
    assert (all_of_them.hint.startswith("correct each"), all_of_them.retry) == (True, "after-fix")


@pytest.mark.parametrize(("options", "key"), [("unit = 900", ".unit"), ("unit = 3", "")], ids=["one", "all together"])
def test_a_fault_in_options_names_file_and_key(write_cell: WriteCell, options: str, key: str) -> None:
    path = write_cell(mode="real")
    wrong = f'"modbus:lights"\noptions = {{ {options} }}'
    path.write_text(path.read_text().replace('"fake:lights"\noptions = {  }', wrong))
    with pytest.raises(ConfigError) as refused:
        CellRuntime.start(load_cell(path), is_latched=lambda: False)
    assert str(path) in refused.value.what
    assert refused.value.details["key"] == f"devices.panel_lights.options{key}"


def test_a_calibration_that_is_not_there_names_the_device_that_wants_it(write_cell: WriteCell) -> None:
    path = write_cell()
    path.write_text(path.read_text().replace('calibration = "wrist_camera"', 'calibration = "wrist_camra"'))
    with pytest.raises(
        ConfigError, match=r"cell.toml: devices.wrist_camera.mount.calibration: .*wrist_camra"
    ) as refused:
        load_cell(path)
    assert "wrist_camera.toml" in refused.value.hint


def test_an_unknown_driver_names_file_key_and_neighbour(write_cell: WriteCell) -> None:
    path = write_cell()
    path.write_text(path.read_text().replace("fake:lights", "fake:lihgts"))
    supervisor = Supervisor(load_cell(path))
    try:
        with pytest.raises(ConfigError) as caught:
            supervisor.start()
    finally:
        supervisor.close()
    assert str(path) in caught.value.what
    assert "devices.panel_lights" in caught.value.what
    assert "fake:lights" in caught.value.hint


def test_killing_the_cell_takes_its_world_along_and_latches_the_stop(write_cell: WriteCell, tmp_path: Path) -> None:
    world_file = tmp_path / "world.pid"
    events: list[str] = []
    supervisor = Supervisor(
        load_cell(write_cell(options={"panel_lights": {"child_pid_file": str(world_file)}})),
        records=Records(note=lambda kind, _data: events.append(kind)),
    )
    try:
        supervisor.start()
        world = psutil.Process(int(eventually(world_file.read_text)))
        first = _pid(supervisor, "cell")
        os.kill(first, signal.SIGKILL)
        eventually(lambda: "cell-down" in events)
        eventually(lambda: not _runs(world))
        assert supervisor.latch.is_set()
        eventually(lambda: supervisor.is_ready)
        assert _pid(supervisor, "cell") != first
        assert supervisor.latch.is_set(), "a restart alone must not free the arm"
        deadline = Deadline.after(supervisor.connection.clock, 1.0)
        assert supervisor.connection.device("panel_lights").read_on(deadline=deadline).value == (False,) * 4
    finally:
        supervisor.close()


def test_a_cell_that_keeps_dying_is_started_again_each_time(
    write_cell: WriteCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.processes.supervisor.PAUSES_S", (0.0, 0.0, 0.01))
    supervisor = Supervisor(load_cell(write_cell()))
    try:
        supervisor.start()
        killed: set[int] = set()

        def kill_the_next() -> bool:
            pid = _pid(supervisor, "cell")
            if supervisor.is_ready and pid not in killed:
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            return len(killed) == 5

        eventually(kill_the_next, timeout_s=60.0)
        eventually(lambda: supervisor.is_ready and _pid(supervisor, "cell") not in killed)
        assert next(p for p in supervisor.processes() if p.name == "cell").restarts == 5
        assert supervisor.latch.is_set()
    finally:
        supervisor.close()


def test_a_service_that_ends_does_not_wait_for_the_pause_before_a_restart(
    write_cell: WriteCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.processes.supervisor.PAUSES_S", (600.0,))
    supervisor = Supervisor(load_cell(write_cell()))
    supervisor.start()
    os.kill(_pid(supervisor, "cell"), signal.SIGKILL)
    eventually(lambda: not supervisor.is_ready)
    supervisor.close()
    assert next(p for p in supervisor.processes() if p.name == "cell").restarts == 0


def test_a_dead_stop_process_latches_and_comes_back(write_cell: WriteCell) -> None:
    events: list[str] = []
    supervisor = Supervisor(load_cell(write_cell()), records=Records(note=lambda kind, _data: events.append(kind)))
    try:
        supervisor.start()
        os.kill(_pid(supervisor, "stop"), signal.SIGKILL)
        eventually(supervisor.latch.is_set)
        eventually(lambda: "stop-process-down" in events)
        eventually(lambda: next(p for p in supervisor.processes() if p.name == "stop").is_alive)
        state = supervisor.latch.state()
        supervisor.reset("test", seen_count=state.count)
        assert not supervisor.latch.is_set()
    finally:
        supervisor.close()


def test_close_leaves_no_process_and_no_file(write_cell: WriteCell, tmp_path: Path) -> None:
    world_file = tmp_path / "world.pid"
    supervisor = Supervisor(load_cell(write_cell(options={"panel_lights": {"child_pid_file": str(world_file)}})))
    supervisor.start()
    pids = [_pid(supervisor, "cell"), _pid(supervisor, "stop"), int(eventually(world_file.read_text))]
    folder = supervisor.folder
    supervisor.close()
    supervisor.close()
    assert not [pid for pid in pids if psutil.pid_exists(pid) and _runs(psutil.Process(pid))]
    assert not folder.exists()


def test_close_latches_the_stop_before_anything_ends(write_cell: WriteCell) -> None:
    supervisor = Supervisor(load_cell(write_cell()), inline=True)
    supervisor.start()
    with Latch(supervisor.folder / "latch") as latch:  # stays readable when its file is gone
        assert not latch.is_set()
        supervisor.close()
        assert latch.is_set()


def test_a_reset_that_has_not_seen_the_newest_stop_is_refused(write_cell: WriteCell) -> None:
    supervisor = Supervisor(load_cell(write_cell()))
    try:
        supervisor.start()
        seen = supervisor.stop("first").count
        supervisor.stop("second")
        with pytest.raises(MotionRefused, match="pressed again"):
            supervisor.reset("test", seen_count=seen)
        assert supervisor.latch.is_set()
    finally:
        supervisor.close()


def test_a_reset_without_an_answer_is_said_and_a_late_answer_clears_nothing(
    write_cell: WriteCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor = Supervisor(load_cell(write_cell()))
    try:
        supervisor.start()
        seen = supervisor.stop("test").count
        stop_pid = _pid(supervisor, "stop")
        os.kill(stop_pid, signal.SIGSTOP)
        monkeypatch.setattr("service.processes.stop_host.RESET_ANSWER_S", 0.05)
        with pytest.raises(MotionRefused, match=r"did not answer|is down"):
            supervisor.reset("test", seen_count=seen)
        monkeypatch.undo()
        os.kill(stop_pid, signal.SIGCONT)
        eventually(lambda: next(p for p in supervisor.processes() if p.name == "stop").is_alive)
        held = supervisor.latch.state().count
        supervisor.stop("the next line that the process obeys")
        eventually(lambda: supervisor.latch.state().count > held)
        assert supervisor.latch.is_set()
        supervisor.reset("test", seen_count=supervisor.latch.state().count)
        assert not supervisor.latch.is_set()
    finally:
        supervisor.close()


@pytest.mark.parametrize("mode", ["mixed", "real"])
def test_only_a_simulated_cell_starts_unlatched(write_cell: WriteCell, mode: str) -> None:
    supervisor = Supervisor(load_cell(write_cell(mode=mode)), inline=True)
    try:
        supervisor.start()
        assert supervisor.latch.is_set()
    finally:
        supervisor.close()


def test_errors_cross_the_process_border_whole() -> None:
    from service.processes.cell_lines import error_from_line, error_to_line

    error: CellError = DeviceUnavailable("x is gone\nentirely", hint="look", device="x")
    back = error_from_line(error_to_line(error))
    assert (type(back), back.what, back.hint, back.details) == (DeviceUnavailable, error.what, "look", {"device": "x"})


def _pid(supervisor: Supervisor, name: str) -> int:
    pid = next(process.pid for process in supervisor.processes() if process.name == name)
    assert pid is not None
    return pid


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
