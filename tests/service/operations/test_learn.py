"""Tests of blind recognition of the simulated cell's panel: with the shipped looks, after a lesson, and as shipped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.vision_simulated import judged, without_looks
from hal.config import Cell, load_cell
from hal.errors import NotFound
from service.knowledge.store import KnowledgeStore
from service.knowledge.teach import teach_surroundings
from service.operations.inspect import ensure_located, inspect_here
from service.operations.recognise import run_learn, run_recognise
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.schema.requests import LearnRequest, RecogniseRequest
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[3]
SEED = 5
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def runtime() -> Iterator[CellRuntime]:
    started = CellRuntime.start(load_cell(ROOT / "cells/bench.toml", seed=SEED), is_latched=lambda: False)
    yield started
    started.close()


def session(runtime: CellRuntime, cell: Cell, folder: Path, memory: WorldModel) -> Session:
    task = TaskContext(Task(id="test", verb="learn", request={}, moves=True), folder / "artefacts")
    local = LocalConnection(cell, runtime.objects, close=runtime.close)
    return Session(
        context=OperationContext(connection=local, task=task, runs_dir=folder / "runs", world=memory),
    )


def blind(session: Session, cell: Cell) -> Any:
    found = run_recognise(session, RecogniseRequest(mode="blind")).candidates
    rows = [{"reason": c.reason, "centre_m": c.centre_m, "kind": c.kind, "confidence": c.confidence} for c in found]
    return judged(cell, SEED, rows)


def test_one_overview_teaches_the_cell_its_panel(runtime: CellRuntime, tmp_path: Path) -> None:
    cell, memory = without_looks(runtime.cell), WorldModel()
    before = blind(session(runtime, cell, tmp_path, memory), cell)
    with pytest.raises(NotFound, match="not been located"):
        run_learn(session(runtime, cell, tmp_path, WorldModel()), LearnRequest(move=False))
    taught = run_learn(session(runtime, cell, tmp_path, memory), LearnRequest())
    assert len(taught.taught_by) == len(cell.panel.objects) and not taught.left_out
    now = blind(session(runtime, cell, tmp_path, memory), cell)
    assert len(before.missed) >= 4 and len(now.missed) <= 1
    assert all(answer.is_right for answer in now.answers)


def test_a_doubted_reading_keeps_what_teaches_its_look(runtime: CellRuntime, tmp_path: Path) -> None:
    cell, memory = without_looks(runtime.cell), WorldModel()
    here = session(runtime, cell, tmp_path, memory)
    ensure_located(here)
    found = inspect_here(here, ["emergency"])
    picture = found.surroundings(cell.panel.object("emergency"))
    assert picture is not None
    store = KnowledgeStore.of_runs(tmp_path / "runs", cell)
    assert teach_surroundings(store, picture, kind="mushroom").added
    assert "emergency" not in blind(here, cell).missed


def test_the_shipped_cell_knows_its_panel_untaught(runtime: CellRuntime, tmp_path: Path) -> None:
    seen = blind(session(runtime, runtime.cell, tmp_path, WorldModel()), runtime.cell)
    assert len(seen.missed) <= 1 and all(answer.is_right for answer in seen.answers)
