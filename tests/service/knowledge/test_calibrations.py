"""Tests of a cell's calibration records: they replace those of the cell file, old ones are kept, listed or refused."""

from __future__ import annotations

from pathlib import Path

import httpx2
import pytest

from hal.calibration import LoadRecord, MountRecord, load_calibration
from hal.config import Cell, load_cell
from hal.errors import ConfigError
from perception.calibration.records import renewed
from service.knowledge.calibrations import Calibrations, NoSuchCalibration
from service.operations import OPERATIONS
from service.schema.requests import CalibrationRequest
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.shown_panel import house, is_problem, web

__all__ = ["house", "web"]  # fixtures
MOVED = MountRecord(position_m=(0.001, -0.09, 0.06), rpy_rad=(0.0, 0.01, 0.0), sigma_m=(2e-4, 2e-4, 2e-4))


@pytest.fixture
def cell(write_cell: WriteCell) -> Cell:
    return load_cell(write_cell(robot=True))


def measured(cell: Cell, calibrations: Calibrations, mount: MountRecord = MOVED) -> Path:
    current = calibrations.of("wrist_camera").record
    found = current.model_copy(update={"mount": mount, "date": "2026-11-21T10:00:00Z", "method": "hand-eye"})
    return calibrations.write(renewed(current, found))


def test_what_was_measured_lies_over_the_cell_file_and_leaves_it_alone(cell: Cell, tmp_path: Path) -> None:
    calibrations = Calibrations.of_runs(tmp_path, cell)
    assert calibrations.applied() is cell and not calibrations.of("wrist_camera").is_measured
    measured(cell, calibrations)
    entry = calibrations.of("wrist_camera")
    assert entry.is_measured and entry.record.version == 2 and entry.record.mount == MOVED
    assert calibrations.applied().calibration_of("wrist_camera").mount == MOVED
    assert calibrations.applied().calibration_of("wrist_ft") == cell.calibration_of("wrist_ft")
    assert load_cell(cell.path).calibration_of("wrist_camera") == cell.calibration_of("wrist_camera")


def test_the_path_of_a_record_is_the_file_that_was_read(tmp_path: Path) -> None:
    shipped = load_cell(Path(__file__).parents[3] / "cells" / "bench.toml")
    entries = Calibrations.of_runs(tmp_path, shipped).all()
    assert [load_calibration(entry.path) for entry in entries] == [entry.record for entry in entries] != []


def test_every_version_is_kept_and_the_newest_can_be_taken_back(cell: Cell, tmp_path: Path) -> None:
    calibrations = Calibrations.of_runs(tmp_path, cell)
    for _ in range(3):
        measured(cell, calibrations)
    entry = calibrations.of("wrist_camera")
    assert entry.record.version == 4
    assert [path.name for path in entry.older] == ["wrist_camera.v2.toml", "wrist_camera.v3.toml"]
    calibrations.forget("wrist_camera")
    assert not calibrations.of("wrist_camera").is_measured
    measured(cell, calibrations)
    calibrations.forget("wrist_camera")
    assert len(calibrations.of("wrist_camera").older) == 4, "nothing is ever overwritten"
    with pytest.raises(NoSuchCalibration, match="nothing to forget"):
        calibrations.forget("wrist_camera")


def test_a_simulated_cell_of_another_seed_is_another_cell(cell: Cell, tmp_path: Path) -> None:
    measured(cell, Calibrations.of_runs(tmp_path, cell))
    other = load_cell(cell.path, seed=99)
    assert Calibrations.of_runs(tmp_path, other).applied() is other


def test_a_broken_record_is_named(cell: Cell, tmp_path: Path) -> None:
    calibrations = Calibrations.of_runs(tmp_path, cell)
    path = measured(cell, calibrations)
    path.write_text("version = 'many'")
    with pytest.raises(ConfigError, match=path.name):
        calibrations.applied()


def test_a_device_without_a_mount_has_nowhere_to_keep_a_record(cell: Cell, tmp_path: Path) -> None:
    calibrations = Calibrations.of_runs(tmp_path, cell)
    record = calibrations.of("wrist_ft").record.model_copy(update={"device": "arm"})
    with pytest.raises(ConfigError, match="no mount"):
        calibrations.write(record)


def test_the_motion_uses_the_measured_load_and_the_devices_the_cell_file(write_cell: WriteCell, tmp_path: Path) -> None:
    from service.processes.cell import CellRuntime

    cell = load_cell(write_cell(robot=True))
    calibrations = Calibrations.of_runs(tmp_path, cell)
    current = calibrations.of("wrist_ft").record
    load = LoadRecord(mass_kg=1.5, centre_of_mass_m=(0.0, 0.0, 0.1), bias_force_n=(1.0, 2.0, 3.0))
    calibrations.write(renewed(current, current.model_copy(update={"load": load, "mount": None})))
    plain = CellRuntime.start(cell, is_latched=lambda: False)
    bare = plain.objects["cell.mover"].state().wrench
    plain.close()
    runtime = CellRuntime.start(load_cell(cell.path), is_latched=lambda: False, runs_dir=tmp_path)
    loaded = runtime.objects["cell.mover"].state().wrench
    runtime.close()
    assert abs(loaded - bare).max() > 0.5
    assert runtime.cell.calibration_of("wrist_ft").load == current.load


def test_calibrations_are_listed_shown_and_taken_back_over_http(web: httpx2.Client, house: Panelwright) -> None:
    names = {entry["device"] for entry in web.get("/v1/calibrations").json()["calibrations"]}
    assert names == {"wrist_camera", "range_scanner", "finger_proximity", "wrist_ft"}
    measured(house.service.cell, house.service.calibrations)
    shown = web.get("/v1/calibrations/wrist_camera").json()
    assert shown["is_measured"] and shown["version"] == 2 and "position_m = [0.001" in shown["toml"]
    frames = {frame["child"]: frame for frame in web.get("/v1/frames").json()["frames"]}
    assert frames["wrist_camera"]["translation_m"][0] == 0.001
    assert web.delete("/v1/calibrations/wrist_camera").status_code == 204
    again = web.get("/v1/calibrations/wrist_camera").json()
    assert not again["is_measured"] and again["older"] == ["wrist_camera.v2.toml"]
    is_problem(web.delete("/v1/calibrations/wrist_camera"), 404, "no-such-calibration", "nothing to forget")
    is_problem(web.get("/v1/calibrations/teapot"), 404, "no-such-calibration", "teapot")


def test_calibrations_that_cannot_be_are_refused(web: httpx2.Client) -> None:
    for body in (
        {},
        {"what": "teapot"},
        {"what": "tool", "poses": 3},
        {"what": "tool", "poses": 41},
        {"what": "tool", "poses": 4.5},
        {"what": "tool", "colour": "red"},
    ):
        assert web.post("/v1/calibrations", json=body).status_code == 422, body
    wrong = web.post("/v1/calibrations?wait_s=30", json={"what": "scanner", "device": "wrist_camera", "dry_run": True})
    is_problem(wrong, 422, "invalid-request", "no range_scanner")
    no_lens = web.post("/v1/calibrations?wait_s=30", json={"what": "hand-eye", "dry_run": True})
    is_problem(no_lens, 422, "config-error", "no [intrinsics]")


def test_a_latched_stop_refuses_to_calibrate_but_lets_plan(web: httpx2.Client) -> None:
    web.post("/v1/stop")
    is_problem(web.post("/v1/calibrations", json={"what": "tool"}), 409, "stopped", "latched")
    planned = web.post("/v1/calibrations?wait_s=30", json={"what": "tool", "poses": 5, "dry_run": True})
    assert planned.status_code == 200, planned.text
    assert len(planned.json()["result"]["stations"]) == 5
    assert web.post("/v1/stop/reset", json={"seen_count": web.get("/v1/stop").json()["count"]}).status_code == 200


def test_a_mount_that_is_not_on_the_hand_is_refused(write_cell: WriteCell, tmp_path: Path) -> None:
    path = write_cell(robot=True)
    on_hand, on_base = (f'parent = "{name}", calibration = "wrist_camera"' for name in ("flange", "base"))
    path.write_text(path.read_text().replace(on_hand, on_base))
    panelwright = Panelwright(load_cell(path), Options(port=0, runs_dir=tmp_path, inline=True), operations=OPERATIONS)
    try:
        panelwright.start()
        with httpx2.Client(base_url=panelwright.url, timeout=60.0, trust_env=False) as http:
            answer = http.post("/v1/calibrations?wait_s=30", json={"what": "camera", "dry_run": True})
        is_problem(answer, 409, "unsupported", "is not mounted on the flange")
    finally:
        panelwright.close()


def test_the_example_of_the_verb_is_a_request() -> None:
    operation = OPERATIONS["calibrations"]
    request = CalibrationRequest(**operation.example)
    assert operation.may_move(request) and not operation.may_move(request.model_copy(update={"dry_run": True}))
