"""Tests of calibration on the simulated cell, inline, as the verb does it, compared with the simulator's truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.calibration import load_calibration
from hal.config import Cell, load_cell
from hal.errors import Cancelled
from hal.geometry import difference
from service.knowledge.calibrations import Calibrations
from service.operations.acquisition import settle
from service.operations.calibrate import run_calibrations
from service.operations.session import OperationContext, Session
from service.operations.travel import kinematics
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.schema.requests import CalibrationRequest
from service.schema.results import CalibrationResult
from service.tasks.gate import GatedConnection
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel
from simbackend.draws import Draws

ROOT = Path(__file__).parents[3]
SEED = 17
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@dataclass(kw_only=True)
class Rig:
    """Inline cell; `session()` begins a new task on it."""

    runtime: CellRuntime
    runs: Path
    cell: Cell
    world: WorldModel = field(default_factory=WorldModel)
    task: Task = field(default_factory=lambda: Task(id="test", verb="calibrations", request={}, moves=True))

    def session(self) -> Session:
        self.task = Task(id="test", verb="calibrations", request={}, moves=True)
        task = TaskContext(self.task, self.runs / "artefacts")
        local = LocalConnection(self.cell, self.runtime.objects, close=self.runtime.close)
        applied = Calibrations.of_runs(self.runs, self.cell).applied()
        connection = GatedConnection(local, task.check_cancelled, cell=applied)
        return Session(context=OperationContext(connection=connection, task=task, runs_dir=self.runs, world=self.world))

    def calibrate(self, what: str, **more: Any) -> CalibrationResult:
        return run_calibrations(self.session(), CalibrationRequest(what=what, **more))


def hurried(cell: Cell) -> Cell:
    """Return the same cell with fewer control ticks per pose, because most of the time is spent on driving."""
    file = cell.file
    return cell.model_copy(
        update={
            "file": file.model_copy(
                update={
                    "cell": file.cell.model_copy(update={"control_rate_hz": 125.0}),
                    "safety": file.safety.model_copy(update={"speed_limit_m_per_s": 0.75}),
                }
            )
        }
    )


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    runtime = CellRuntime.start(hurried(load_cell(ROOT / "cells/bench.toml", seed=SEED)), is_latched=lambda: False)
    yield Rig(runtime=runtime, cell=runtime.cell, runs=tmp_path_factory.mktemp("runs"))
    runtime.close()


def off_by(rig: Rig, device: str, path: str) -> tuple[float, float]:
    """Return the error of a written mount, compared with the truth of the seed, in m and degrees."""
    built = rig.cell.calibration_of(device).mount
    found = load_calibration(Path(path)).mount
    assert built is not None and found is not None
    e = difference(Draws(SEED).mount(device, built), found.pose().parent_from_child)
    return float(np.linalg.norm(e[:3])), float(np.degrees(np.linalg.norm(e[3:])))


def test_a_dry_run_plans_and_neither_moves_nor_writes(rig: Rig) -> None:
    before = rig.session().mover.state().position_rad
    for what in ("hand-eye", "scanner", "tool"):
        plan = rig.calibrate(what, poses=5, dry_run=True)
        assert len(plan.stations) == 5
    np.testing.assert_array_equal(rig.session().mover.state().position_rad, before)
    assert not (rig.runs / "calibrations").exists()


def test_hand_eye_with_twelve_poses_then_the_scanner(rig: Rig) -> None:
    result = rig.calibrate("hand-eye", poses=12)
    shift_m, turn_deg = off_by(rig, "wrist_camera", result.path)
    assert shift_m < 1e-3 and turn_deg < 0.2
    quality = result.record.quality
    assert quality["views"] >= 10 and 0.2 < quality["chi_square_ratio"] < 3.0
    assert result.record.version == 2 and result.in_use_from == "now"
    assert rig.session().mount("wrist_camera").covariance[0, 0] == pytest.approx(result.record.mount.sigma_m[0] ** 2)
    settle(rig.session(), 0.3)
    home = kinematics(rig.session()).flange(np.array(rig.cell.file.workspace.park_rad))
    assert np.linalg.norm((home.inv() * rig.session().mover.state().base_from_flange).translation) < 0.005
    scanned = rig.calibrate("scanner", poses=8)
    shift_m, turn_deg = off_by(rig, "range_scanner", scanned.path)
    assert shift_m < 2e-3 and turn_deg < 0.2


def test_the_tool_is_weighed_and_the_bias_found(rig: Rig) -> None:
    result = rig.calibrate("tool", poses=8)
    found = load_calibration(Path(result.path)).load
    built = rig.cell.calibration_of("wrist_ft").load
    assert found is not None and built is not None
    truth = Draws(SEED).load("wrist_ft", built.load())
    assert abs(found.mass_kg - truth.mass_kg) < 0.02
    assert np.linalg.norm(np.subtract(found.bias_force_n, truth.bias[:3])) < 0.5  # the drift is 0.15 N per axis
    assert result.in_use_from == "the next start of the service"


def test_a_cancelled_calibration_writes_nothing(rig: Rig) -> None:
    session = rig.session()
    before = sorted((rig.runs / "calibrations").rglob("*.toml"))
    moves = 0

    def cancel_after_two(_report: object) -> None:
        nonlocal moves
        moves += 1
        if moves == 2:
            rig.task.cancel_asked.set()

    watched = Session(context=session.context, observers=(cancel_after_two,))
    with pytest.raises(Cancelled):
        run_calibrations(watched, CalibrationRequest(what="tool", poses=8))
    assert moves == 2, "nothing starts after a cancel"
    assert sorted((rig.runs / "calibrations").rglob("*.toml")) == before
