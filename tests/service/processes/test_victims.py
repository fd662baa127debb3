"""When the memory runs out, the system ends what computes and not what moves or stops the arm."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hal.child_python import module_command
from service.chaos.plant import Plant
from tests.service.conftest import WriteCell


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can be told")
def test_the_service_is_ended_before_its_cell_and_its_stop_process(write_cell: WriteCell, tmp_path: Path) -> None:
    cell = write_cell(robot=True)
    plant = Plant(
        command=lambda port, stop_port, runs: module_command(
            "tests.service.chaos.served", str(cell), str(port), str(stop_port), str(runs)
        ),
        runs=tmp_path / "runs",
    )
    try:
        plant.start()
        plant.await_ready(120.0)
        scores = {
            role: int(Path(f"/proc/{process.pid}/oom_score_adj").read_text(encoding="ascii"))
            for role, process in plant.roles().items()
        }
        plant.end()
    finally:
        plant.sweep()
    assert scores["cell"] == scores["stop"] < scores["service"], scores
