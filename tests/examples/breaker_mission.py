"""Runs and judges a mission on the example package's own panel, then recognises it blind; prints the result as JSON.

`python breaker_mission.py FOLDER SEED`, where the package is installed: a test of the example package starts it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.missions import changed
from hal.config import load_cell
from service.evaluate import evaluate
from service.operations.mission import run_mission
from service.operations.recognise import run_recognise
from service.operations.session import OperationContext, Session
from service.processes.cell import CellRuntime
from service.processes.connection import LocalConnection
from service.schema.mission_request import MissionRequest
from service.schema.requests import RecogniseRequest
from service.tasks.model import Task
from service.tasks.store import TaskContext
from service.world_model import WorldModel

ROOT = Path(__file__).parents[2]


def main(folder: Path, seed: int) -> None:
    """Print the report's readings, its verdict and the kinds that were recognised."""
    path = changed(ROOT / "cells/bench.toml", ROOT / "examples/kind-package/panel.toml", None, folder)
    cell = load_cell(path, seed=seed)
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        connection = LocalConnection(cell, runtime.objects, close=runtime.close)
        task = TaskContext(Task(id="test", verb="missions", request={}, moves=True), folder / "artefacts")
        context = OperationContext(connection=connection, task=task, runs_dir=folder / "runs", world=WorldModel())
        run_mission(context, MissionRequest(file="demo"))
        (report,) = folder.glob("runs/*/report.json")
        verdict = evaluate(connection, report.parent)
        found = run_recognise(Session(context=context), RecogniseRequest(mode="blind")).candidates
    finally:
        runtime.close()
    said = json.loads(report.read_text(encoding="utf-8"))
    readings = {f"{each['name']}, {each['when']}": each["shows"] for each in said["readings"]}
    claims = [[claim.name, claim.what, claim.right] for claim in verdict.claims]
    kinds = sorted(each.kind for each in found if each.reason is None)
    print(json.dumps({"readings": readings, "claims": claims, "agrees": verdict.agrees, "kinds": kinds}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
